"""Figures on their way into `Metrics`."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Literal

import numpy as np

from scanloom.schemas.evaluation import Metrics
from scanloom.schemas.metrics import kind_of

Scope = Literal["session", "map"]


@dataclass(frozen=True)
class Figure:
    """One row of `Metrics`."""

    name: str
    value: float
    unit: str
    method: str
    scope: Scope = "session"
    session: str = ""
    samples: int | None = None
    """From how many samples it was computed; None for a plain count of everything."""

    @property
    def how(self) -> str:
        """Method and number of samples."""
        return self.method if self.samples is None else f"{self.method}; {self.samples} samples"


def needs_truth(name: str) -> bool:
    """Whether a metric is computed with the help of truth."""
    kind = kind_of(name)
    return kind is not None and kind.truth


def to_metrics(figures: Iterable[Figure]) -> Metrics:
    """All figures as a table, in the order given; those that are not finite are left out."""
    rows = [figure for figure in figures if np.isfinite(figure.value)]

    def strings(name: str) -> np.ndarray:
        return np.array([getattr(row, name) for row in rows], object)

    return Metrics(
        name=strings("name"),
        value=np.array([row.value for row in rows], float),
        unit=strings("unit"),
        scope=strings("scope"),
        session=strings("session"),
        method=strings("how"),
        samples=np.array([-1 if row.samples is None else row.samples for row in rows], np.int64),
        truth=np.array([needs_truth(row.name) for row in rows], bool),
    )
