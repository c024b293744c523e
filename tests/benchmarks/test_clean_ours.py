"""Our stages of cleaning, run without the engine: they say what the engine has them say."""

from __future__ import annotations

import itertools
from pathlib import Path

import numpy as np

from benchmarks.clean_gathering import LEFT_OUT
from benchmarks.clean_ours import Job
from benchmarks.clean_scenes import of_session
from scanloom.schemas.clean import FinalLabels
from scanloom.schemas.scans import Deskewed, Labels, PointClass
from tests.mapped import Mapped


def test_stages_alone_say_what_the_engine_says(small: Mapped, tmp_path: Path) -> None:
    result = small.result
    deskewed, labels = list(result.parts(Deskewed)), list(result.parts(Labels))
    job = Job(deskewed, labels, {p: result.parts(p)[0] for p in of_session()}, {}, tmp_path)
    rays = [file for number in range(len(deskewed)) for file in job.rays(number)]

    def tile(file: object) -> str:
        return dict(file[0])["tile"]  # type: ignore[index]

    tiles = itertools.groupby(sorted(rays, key=tile), key=tile)
    cleared = sorted(file for name, files in tiles for file in job.cleared(name, list(files)))
    found = [classes for number in range(len(deskewed)) for classes in job.classes(number, cleared)]
    engine = [scan for part in result.parts(FinalLabels) for scan in part]
    counts = [~np.isin(scan.class_, LEFT_OUT) for part in labels for scan in part]
    assert len(found) == len(engine) == len(counts)
    for classes, scan, own in zip(found, engine, counts, strict=True):
        assert np.array_equal(classes, scan.class_[own])
    assert (np.concatenate(found) == PointClass.DYNAMIC).any()
