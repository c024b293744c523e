"""How far a run has come: bars with the time left on a terminal, plain lines elsewhere."""

from __future__ import annotations

import logging
import time
from collections.abc import Mapping, Sequence
from typing import IO, Protocol

log = logging.getLogger("scanloom.progress")


class Progress(Protocol):
    """Hears what happens in a run. Counts grow while it runs: chunks are known when a session is read."""

    def begin(self, stages: Sequence[tuple[str, str]]) -> None:
        """The run starts; (name, title) of its stages in order."""

    def update(self, counts: Mapping[str, tuple[int, int, int]]) -> None:
        """(over, under way, known) tasks of each stage."""

    def note(self, text: str) -> None:
        """Something worth a line: a failure, a skipped session."""

    def end(self) -> None:
        """The run is over."""


class Silent:
    """Says nothing."""

    def begin(self, stages: Sequence[tuple[str, str]]) -> None:
        pass

    def update(self, counts: Mapping[str, tuple[int, int, int]]) -> None:
        pass

    def note(self, text: str) -> None:
        pass

    def end(self) -> None:
        pass


class Lines:
    """One line through `logging` whenever a stage is done, for every note, and now and then for a stage that takes long."""

    def __init__(self, every_s: float = 30.0) -> None:
        self._titles: dict[str, str] = {}
        self._said: dict[str, tuple[int, int]] = {}
        self._since: dict[str, float] = {}
        self._every_s = every_s
        self._last = self._started = time.monotonic()

    def begin(self, stages: Sequence[tuple[str, str]]) -> None:
        self._titles = dict(stages)
        self._said, self._since = {}, {}
        self._last = self._started = time.monotonic()

    def update(self, counts: Mapping[str, tuple[int, int, int]]) -> None:
        for name, (over, running, known) in counts.items():
            if running:
                self._since.setdefault(name, time.monotonic())
            complete = known and over == known and not running
            if complete and self._said.get(name) != (over, known):
                self._said[name] = (over, known)
                self._say(name, over, known)
        if time.monotonic() - self._last > self._every_s:
            self._say_under_way(counts)

    def _say_under_way(self, counts: Mapping[str, tuple[int, int, int]]) -> None:
        for name, (over, running, known) in counts.items():
            if running and 0 < over < known:
                left_s = (time.monotonic() - self._since[name]) / over * (known - over)
                self._say(name, over, known, f", about {left_s:.0f} s left")

    def _say(self, name: str, over: int, known: int, more: str = "") -> None:
        self._last = time.monotonic()
        log.info("%6.1f s  %s: %d of %d%s", self._last - self._started, self._titles[name], over, known, more)

    def note(self, text: str) -> None:
        log.warning("%s", text)

    def end(self) -> None:
        pass


class Bars:
    """Bars with the time left, by rich; they vanish at the end."""

    def __init__(self, stream: IO[str]) -> None:
        from rich.console import Console
        from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn
        from rich.progress import TimeRemainingColumn as Remaining

        self._bars = Progress(
            TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeElapsedColumn(), Remaining(),
            console=Console(file=stream), transient=True,
        )  # fmt: skip
        self._rows: dict[str, int] = {}
        self._titles: dict[str, str] = {}

    def begin(self, stages: Sequence[tuple[str, str]]) -> None:
        self._titles = dict(stages)
        self._bars.start()

    def update(self, counts: Mapping[str, tuple[int, int, int]]) -> None:
        for name, (over, running, known) in counts.items():
            if not over and not running:
                continue
            if name not in self._rows:
                self._rows[name] = self._bars.add_task(self._titles[name], total=known)
            self._bars.update(self._rows[name], completed=over, total=known)  # type: ignore[arg-type]

    def note(self, text: str) -> None:
        self._bars.console.print(text, markup=False, highlight=False)

    def end(self) -> None:
        self._bars.stop()


def progress_for(stream: IO[str]) -> Progress:
    """Bars when `stream` (usually stderr) is a terminal, lines otherwise."""
    return Bars(stream) if stream.isatty() else Lines()
