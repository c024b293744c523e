"""Relabel: the final class of every point of a chunk, from what the whole map says of its place.

A point's voxel says whether what the session met there moved or has changed. Of a thing that hangs together in a scan, most
of which moved, all moved: its wheels, which rays to the ground hardly pass, and its roof before the sky, which none passes.
What the tracker saw drive about moved as well, wherever its box is; free space alone cannot know of a car that stood where
nobody looked again. What is in the air is decided anew, with all that the map knows (`airborne`): dust was seen through before
and after, too, and the tracker may have followed a cloud. What denoise took for a stray or for something that moves, and the
map knows to stand, is restored. Own vehicle and range stay as they are, and ground, but for what of it is too high in a moving
box, and for what was no ground but dust or snow close above it.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field

from scanloom.schemas.clean import ClassCounts, Cleared, FinalLabels, Standing
from scanloom.schemas.objects import ObjectTracks
from scanloom.schemas.product import Parts
from scanloom.schemas.scans import Deskewed, DeskewedScan, Labels, PointClass, ScanLabels
from scanloom.schemas.trajectory import Poses
from scanloom.stages.clean import incidence
from scanloom.stages.clean.airborne import TAKEN, Known, airborne, by_standing, light_of, may_fly
from scanloom.stages.clean.clusters import clusters
from scanloom.stages.clean.lookup import Verdicts
from scanloom.stages.clean.moving import MovingBoxes, where_boxed
from scanloom.stages.clean.things import judge_things, settle
from scanloom.stages.geometry.se3 import F8

VERSION = 5

U1 = NDArray[np.uint8]
B1 = NDArray[np.bool_]
F4 = NDArray[np.float32]
I4 = NDArray[np.int32]
I8 = NDArray[np.int64]
AIRBORNE = int(PointClass.AIRBORNE)
JUDGED = (PointClass.UNLABELLED, PointClass.STATIC, PointClass.DYNAMIC)
ASKED = np.isin(list(PointClass), (*JUDGED, PointClass.AIRBORNE, PointClass.OUTLIER))
"""Classes whose places are looked up."""


class Settings(BaseModel):
    """How the points of a scan are decided together."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    apart_m: float = Field(
        0.4,
        ge=0.05,
        le=5.0,
        description="neighbours in a scan whose ranges differ by less belong together, m",
    )
    moved_share: float = Field(
        0.4,
        ge=0.05,
        le=1.0,
        description="a thing moved as a whole when this share of its points did, what stands left aside",
    )
    whole_share: float = Field(
        0.6, ge=0.05, le=1.0, description="the same of a thing with all that hangs on it, even if that stands"
    )
    least_points: int = Field(
        5, ge=1, le=1000, description="points that hang together are a thing from this number on"
    )
    box_margin_m: float = Field(
        0.1, ge=0.0, le=2.0, description="points this close to the box of a moving object moved, m"
    )
    wide_box_margin_m: float = Field(
        0.3, ge=0.0, le=2.0, description="so did points this close to it whose place does not stand, m"
    )
    foot_m: float = Field(
        0.08, ge=0.0, le=1.0, description="points in such a box this far above its foot are no ground, m"
    )
    particles: bool = Field(
        True,
        description="decide anew what is in the air, with all that the map knows; else what denoise says of it stays, "
        "but for what stands",
    )


def relabel(
    settings: Settings,
    deskewed: Deskewed,
    labels: Labels,
    tracks: ObjectTracks,
    cleared: Parts[Cleared],
    poses: Poses,
) -> Iterator[FinalLabels | ClassCounts]:
    """A class for every point of every scan of a chunk, scan by scan, in the order of the points; then their numbers.

    Scans without a pose keep the classes they have.
    """
    counts: list[tuple[int, I8, I8]] = []
    yield FinalLabels(
        _counting(_relabelled(settings, deskewed, labels, _Map(tracks, cleared, poses)), counts)
    )
    index, before, after = zip(*counts) if counts else ((), (), ())
    shape = (len(counts), len(PointClass))
    yield ClassCounts(
        scan_index=np.array(index, np.int64),
        points=np.array(after, np.int64).reshape(shape),
        before=np.array(before, np.int64).reshape(shape),
    )


class _Map:
    """What the whole map says of a scan."""

    def __init__(self, tracks: ObjectTracks, cleared: Parts[Cleared], poses: Poses) -> None:
        self.verdicts, self.image, self.moving = Verdicts(cleared), incidence.new_image(), MovingBoxes(tracks)
        self._T = {int(i): T for i, T in zip(poses.scan_index, poses.T_world_lidar) if np.isfinite(T).all()}

    def pose(self, scan: DeskewedScan) -> F8 | None:
        return self._T.get(scan.scan_index)


def _relabelled(
    settings: Settings, deskewed: Deskewed, labels: Labels, known: _Map
) -> Iterator[tuple[ScanLabels, ScanLabels]]:
    for scan, label in zip(deskewed, labels, strict=True):
        classes = final(settings, scan, label.class_, known)
        yield label, ScanLabels(class_=classes, reference_ns=label.reference_ns, scan_index=label.scan_index)


def _counting(
    pairs: Iterator[tuple[ScanLabels, ScanLabels]], counts: list[tuple[int, I8, I8]]
) -> Iterator[ScanLabels]:
    for before, after in pairs:
        counts.append((after.scan_index, _counted(before.class_), _counted(after.class_)))
        yield after


def _counted(classes: U1) -> I8:
    return np.array([np.count_nonzero(classes == int(each)) for each in PointClass], np.int64)


def final(settings: Settings, scan: DeskewedScan, classes: U1, known: _Map) -> U1:
    """Final classes (n,) of the points of one scan."""
    T_world_lidar = known.pose(scan)
    if T_world_lidar is None:
        return classes
    said = known.verdicts.of(scan, classes, ASKED, T_world_lidar)
    cell, away_m = incidence.fill(scan.x_m, scan.y_m, scan.z_m, known.image)
    boxes = known.moving.of(scan)
    box, around, above = where_boxed(
        scan, boxes, settings.box_margin_m, settings.wide_box_margin_m, settings.foot_m
    )
    if settings.particles:
        taken = by_standing(said, classes, TAKEN)
        light = light_of(scan, said)
        asked, contrast = may_fly(scan, classes, said, taken, cell, away_m, known.image, light)
        beside = known.verdicts.around(scan, asked, T_world_lidar)
        all_known = Known(
            classes, said, box, around, cell, away_m, known.image, taken, asked, beside, contrast, light
        )
        fly = airborne(scan, all_known, settings.apart_m)
    else:
        fly = (classes == AIRBORNE) & (said != Standing.STANDS) & (box < 0)
    out, judged = settle(classes, said, fly, box, around, above)
    _decide_things(settings, away_m, cell, said, judged, out)
    return out


def _decide_things(settings: Settings, away_m: F4, cell: I4, said: U1, judged: B1, out: U1) -> None:
    """Write what moved or has changed into the classes `out` (n,), whole things with what is told of most of them."""
    for usable, least in (
        (judged, settings.whole_share),
        (judged & (said != Standing.STANDS), settings.moved_share),
    ):
        thing = clusters(away_m, usable, cell, settings.apart_m)
        judge_things(thing, judged, usable, said, settings.least_points, least, out)
