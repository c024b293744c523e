"""How far exports are, told to whoever shows progress."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from types import TracebackType

from scanloom.pipeline.progress import Progress
from scanloom.stages.exports.formats import Format
from scanloom.stages.exports.source import MapSource


class Heard:
    """Counts tiles, format by format. A format that reads no tiles is one step."""

    def __init__(self, progress: Progress, formats: Sequence[Format], tiles: int) -> None:
        self._progress = progress
        self._formats = formats
        self._total = {entry.name: max(entry.passes * tiles, 1) for entry in formats}
        self._over = dict.fromkeys(self._total, 0)

    def __enter__(self) -> Heard:
        self._progress.begin([(entry.name, f"{entry.name} ({entry.doc})") for entry in self._formats])
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._progress.end()

    def listening(self, source: MapSource, entry: Format) -> MapSource:
        """The map, whose tiles are counted for this format from now on."""

        def passed() -> None:
            self._over[entry.name] = min(self._over[entry.name] + 1, self._total[entry.name] - 1)
            self._tell(entry, 1)

        self._tell(entry, 1)
        return replace(source, passed=passed)

    def over(self, entry: Format, fresh: bool) -> None:
        """It is written, or was found as it should be, of which nothing is said."""
        self._over[entry.name] = self._total[entry.name]
        if fresh:
            self._tell(entry, 0)

    def _tell(self, entry: Format, running: int) -> None:
        self._progress.update({entry.name: (self._over[entry.name], running, self._total[entry.name])})
