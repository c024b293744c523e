"""The verb `view`: a finished map in the browser of this machine."""

from __future__ import annotations

import threading
import webbrowser
from collections.abc import Callable
from pathlib import Path

from scanloom.workflows.viewer.answers import Answers
from scanloom.workflows.viewer.server import Server


def view_map(folder: Path, port: int, browser: bool, say: Callable[[str], None]) -> None:
    """Serve a map until the user stops it.

    Raises
    ------
    InvalidInput : the folder holds no map.
    UsageError : the port is taken.
    """
    answers = Answers(folder)
    with Server(port, answers) as server:
        say(f"{folder}: {server.url}   stop with Ctrl-C")
        threading.Thread(target=answers.prepare, daemon=True).start()
        if browser:
            threading.Thread(target=webbrowser.open, args=(server.url,), daemon=True).start()
        try:
            server.serve_forever(poll_interval=0.2)
        except KeyboardInterrupt:
            say("stopped")
