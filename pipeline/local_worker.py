"""Imported first by the process that local workers fork from, and by nothing else.

Ctrl-C reaches every process of the terminal. It is for the driver, which then stops its workers; they themselves
ignore it, instead of dying with a traceback each.

Garbage is not looked for while modules are imported: they make many objects that stay, and looking through them took a
fifth of the time. Workers never look at those again.
"""

import gc
import os
import signal

signal.signal(signal.SIGINT, signal.SIG_IGN)
gc.disable()
os.register_at_fork(before=gc.freeze, after_in_child=gc.enable)
