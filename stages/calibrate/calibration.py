"""A rig's calibration from its boards, and everything that speaks for or against it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace

from scanloom.stages.calibrate.acceptance import Checks, check
from scanloom.stages.calibrate.boards import Pair, agree, pairs_of, scattered, strangers
from scanloom.stages.calibrate.doubts import (
    blurred,
    check_count,
    check_lenses,
    check_mounting,
    check_scale,
    check_start,
    why_strange,
)
from scanloom.stages.calibrate.graph import Estimate, solve
from scanloom.stages.calibrate.noise import Noise
from scanloom.stages.calibrate.paper import solve_paper
from scanloom.stages.calibrate.scene import Scene
from scanloom.stages.calibrate.settings import CalibrateSettings
from scanloom.stages.calibrate.start import Start, same_boards, start
from scanloom.stages.geometry.se3 import F8

VERSION = 1

_ROUGH = (0.01, 0.005, 0.005, 0.005)
"""Errors of whole boards for the first look, before it is known how well they agree."""


@dataclass(frozen=True)
class Found:
    """The calibration and what it rests on."""

    scene: Scene
    """What is in use, corners in the right order."""
    everything: Scene
    """With what was left out."""
    estimate: Estimate
    noise: Noise
    pairs: list[Pair]
    checks: Checks
    left_out: dict[tuple[str, str], str] = field(default_factory=dict)
    """Reasons by placement and camera."""


def calibrate(scene: Scene, settings: CalibrateSettings, given: Mapping[str, F8] | None = None) -> Found:
    """Poses of all cameras of a scene; `given` are poses somebody believes in.

    Raises
    ------
    InvalidInput : fewer than three placements, lenses or images of two cameras swapped, a board of another size, or
        clouds and images that do not show the same boards.
    """
    everything = scene = same_boards(scene)
    check_count(scene)
    check_lenses(scene)
    left_out = blurred(scene, settings.scatter_px)
    scene = scene.without(left_out)
    check_count(scene, left_out)
    check_scale(scene)
    first = start(scene, given if settings.start == "given" else None)
    check_start(first)
    scene, strange = _familiar(first, settings)
    left_out = {**left_out, **strange}
    check_count(scene, left_out)
    noise = _noise(settings)
    begin = first.T_lidar_camera
    if settings.method == "board":
        rough = solve(scene, *_begin(scene, begin, noise.with_bias(_ROUGH, _ROUGH[3]), settings))
        begin, noise = rough.T_lidar_camera, scattered(scene, noise, rough.T_lidar_camera, rough.sensor)
    solver = solve_paper if settings.method == "paper" else solve
    estimate = solver(scene, begin, noise)
    check_mounting(estimate.T_lidar_camera, given or {})
    return Found(
        scene,
        everything,
        estimate,
        noise,
        pairs_of(scene, noise, estimate.sensor),
        check(scene, estimate, noise, settings, solver),
        left_out,
    )


def _begin(
    scene: Scene, begin: Mapping[str, F8], noise: Noise, settings: CalibrateSettings
) -> tuple[Mapping[str, F8], Noise]:
    """Whole boards bring the start near. One that was given is tried as it is, by plain squares: hundreds of pixels off,
    a loss that grows slowly knows no way."""
    if settings.start == "given":
        return begin, replace(noise, softness=_NO_LIMIT)
    return agree(pairs_of(scene, noise), begin).T_lidar_camera, noise


_NO_LIMIT = 1e9


def _noise(settings: CalibrateSettings) -> Noise:
    noise = Noise(
        corner_least_px=settings.corner_least_px,
        beam_offset_m=settings.beam_offset_m,
        lens_share=settings.lens_share,
        lens_bend_px=settings.lens_bend_px,
    )
    return noise if settings.lidar == "estimated" else noise.believing()


def _familiar(first: Start, settings: CalibrateSettings) -> tuple[Scene, dict[tuple[str, str], str]]:
    """The scene without what does not fit, and why each of that was left out.

    A board that is strange to most cameras that saw it was strange to the LiDAR: then all its images go.
    """
    pairs = pairs_of(first.scene, _noise(settings).with_bias(_ROUGH, _ROUGH[3]))
    known = agree(pairs, first.T_lidar_camera)
    found = strangers(pairs, known.T_lidar_camera, settings.stranger)
    reasons = {(s.pair.placement, s.pair.camera): why_strange(s) for s in found}
    for p in first.scene.placements:
        strange = [reasons[p.name, c] for c in p.images if (p.name, c) in reasons]
        if 2 * len(strange) > len(p.images):
            reasons.update({(p.name, c): reasons.get((p.name, c), strange[0]) for c in p.images})
    return first.scene.without(reasons), reasons
