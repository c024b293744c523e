"""The verb `view`: a finished map in the browser of this machine."""

from __future__ import annotations

import threading
import webbrowser
from collections.abc import Callable
from pathlib import Path
from typing import Any

from scanloom.workflows.viewer.answers import Answers
from scanloom.workflows.viewer.server import Server


def view_map(
    folder: Path,
    port: int,
    browser: bool,
    say: Callable[[str], None],
    tell: Callable[[dict[str, Any]], None] | None = None,
) -> None:
    """Serve a map until the user stops it.

    tell : is given the address for a machine, instead of a line for `say`.

    Raises
    ------
    InvalidInput : the folder holds no map.
    UsageError : the port is taken.
    """
    answers = Answers(folder)
    with Server(port, answers) as server:
        if tell is not None:
            tell({"map": str(folder), "url": server.url, "points": answers.source.points})
        else:
            say(f"{folder}: {server.url}   stop with Ctrl-C")
        threading.Thread(target=answers.prepare, daemon=True).start()
        if browser:
            threading.Thread(target=webbrowser.open, args=(server.url,), daemon=True).start()
        try:
            server.serve_forever(poll_interval=0.2)
        except KeyboardInterrupt:
            say("stopped")
