"""How much metrics differ from run to run when nothing has changed: measured from repeats of the same log.

Two single runs whose metric has a standard deviation s differ by more than t s sqrt(2) only once in a thousand times, t being
Student's for so many repeats: 22 for three, 7.2 for five, 4.3 for ten. With few repeats s itself is hardly known, and
much must be allowed.
"""

from __future__ import annotations

import json
import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from scanloom.schemas.errors import InvalidInput, UsageError

NOISE_FORMAT = "scanloom noise 1"
LEAST_REPEATS = 3
CHANCE = 0.001
"""Of a false alarm, for each metric."""

Key = tuple[str, str]
"""Name of a metric and its session."""


@dataclass(frozen=True)
class Spread:
    """What repeats say of one metric."""

    mean: float
    deviation: float
    """Standard deviation of the sample."""
    repeats: int


@dataclass(frozen=True)
class Noise:
    """What repeats say of every metric."""

    spreads: Mapping[Key, Spread]
    maps: tuple[str, ...]

    def tolerance(self, key: Key) -> float | None:
        """How much worse a metric may be in another run without meaning anything; None for one that was not measured, or that
        did not vary: what happens once in ten runs, a scan that is lost, is not seen in three."""
        spread = self.spreads.get(key)
        if spread is None or spread.repeats < LEAST_REPEATS or spread.deviation == 0.0:
            return None
        return _student(spread.repeats - 1) * math.sqrt(2.0) * spread.deviation

    def as_json(self) -> dict[str, Any]:
        rows = [{"name": n, "session": s, **vars(spread)} for (n, s), spread in self.spreads.items()]
        return {"format": NOISE_FORMAT, "maps": list(self.maps), "metrics": rows}

    def write(self, path: Path) -> None:
        """As JSON.

        Raises
        ------
        UsageError : the file cannot be written.
        """
        try:
            path.write_text(json.dumps(self.as_json(), indent=1) + "\n")
        except OSError as error:
            raise UsageError(f"cannot be written: {error.strerror}", where=str(path)) from error


def measured(runs: Sequence[tuple[str, Iterable[Mapping[str, Any]]]]) -> Noise:
    """Noise from the metrics of repeats, each with its name.

    Raises
    ------
    UsageError : there are fewer than three.
    """
    if len(runs) < LEAST_REPEATS:
        raise UsageError(
            f"{len(runs)} runs do not tell how much metrics vary",
            next_step=f"give at least {LEAST_REPEATS} maps of the same log, made with different seeds or on different days",
        )
    values: dict[Key, list[float]] = {}
    for _, rows in runs:
        for row in rows:
            key = (str(row["name"]), str(row.get("session", "")))
            values.setdefault(key, []).append(float(row["value"]))
    spreads = {key: _spread(found) for key, found in values.items() if len(found) >= LEAST_REPEATS}
    return Noise(spreads, tuple(name for name, _ in runs))


def read_noise(path: Path) -> Noise:
    """What `Noise.write` wrote.

    Raises
    ------
    InvalidInput : it is something else, or damaged.
    """
    try:
        body = json.loads(path.read_text())
        if body.get("format") != NOISE_FORMAT:
            raise ValueError(f"its format is {body.get('format')!r}, not {NOISE_FORMAT!r}")
        spreads = {
            (str(row["name"]), str(row["session"])): Spread(
                float(row["mean"]), float(row["deviation"]), int(row["repeats"])
            )
            for row in body["metrics"]
        }
        return Noise(spreads, tuple(map(str, body["maps"])))
    except (OSError, ValueError, KeyError, TypeError, AttributeError) as error:
        raise InvalidInput(
            f"is no file of noise: {error}",
            where=str(path),
            next_step="write one with `scanloom compare --measure-noise FILE MAP MAP MAP`",
        ) from error


def _spread(values: list[float]) -> Spread:
    return Spread(float(np.mean(values)), float(np.std(values, ddof=1)), len(values))


def _student(freedom: int) -> float:
    """Quantile of Student's distribution that is exceeded once in a thousand times."""
    from scipy.special import stdtrit

    return float(stdtrit(freedom, 1.0 - CHANCE))
