"""Imported first by the process that local workers fork from, and by nothing else.

Ctrl-C reaches every process of the terminal. It is for the driver, which then stops its workers; they themselves
ignore it, instead of dying with a traceback each.
"""

import signal

signal.signal(signal.SIGINT, signal.SIG_IGN)
