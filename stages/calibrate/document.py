"""The calibration as a document and as figures."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from scanloom.schemas.calibration import Calibration, Certainty, Matrix6, Placement, Repeatability, Sighting
from scanloom.schemas.cameras import Camera
from scanloom.schemas.session import Matrix4
from scanloom.stages.calibrate.acceptance import Miss, together
from scanloom.stages.calibrate.calibration import Found
from scanloom.stages.calibrate.cloud.evidence import SENSOR
from scanloom.stages.calibrate.observability import weakness
from scanloom.stages.calibrate.settings import CalibrateSettings
from scanloom.stages.geometry.se3 import F8

Row = dict[str, object]
_FEW = 5
"""Placements that leave little to check a calibration with."""


def document(
    found: Found, cameras: Mapping[str, Camera], settings: CalibrateSettings, unseen: Mapping[str, str]
) -> Calibration:
    """Everything that is known; `unseen` are placements without a board, with the reason."""
    certainty = tuple(_certainty(found, camera) for camera in found.scene.cameras)
    repeatability = tuple(
        _repeatability(found, camera) for camera in found.scene.cameras if camera in found.checks.spread
    )
    verdict, reason = judged(found, certainty, repeatability, settings)
    estimate = found.estimate
    return Calibration(
        cameras=tuple(
            cameras[name].model_copy(
                update={
                    "model": estimate.models[name],
                    "T_lidar_camera": matrix(estimate.T_lidar_camera[name]),
                    "source": "calibration",
                }
            )
            for name in found.scene.cameras
        ),
        method=settings.method,
        verdict="good" if verdict else "doubtful",
        reason=reason,
        certainty=certainty,
        placements=_placements(found, unseen),
        repeatability=repeatability,
        remarks=tuple(_remarks(found, settings)),
    )


def matrix(T: F8) -> Matrix4:
    """As documents hold a pose."""
    a, b, c, d = ([float(v) for v in row] for row in T)
    return _four(a), _four(b), _four(c), _four(d)


def _four(v: list[float]) -> tuple[float, float, float, float]:
    return v[0], v[1], v[2], v[3]


def _certainty(found: Found, camera: str) -> Certainty:
    covariance = found.estimate.camera_covariance(camera)
    sigma = np.sqrt(np.diag(covariance))
    mine = [pair for pair in found.pairs if pair.camera == camera]
    weak = weakness(covariance, found.estimate.models[camera], found.scene.board, mine)
    left_out = _of(found.checks.left_out, camera)
    as_read = _of(found.checks.left_out_as_read, camera)
    rows: Matrix6 = tuple(tuple(float(v) for v in row) for row in covariance)  # type: ignore[misc]
    return Certainty(
        camera=camera,
        covariance=rows,
        rotation_sigma_deg=_three(np.degrees(sigma[:3])),
        translation_sigma_m=_three(sigma[3:]),
        scale=found.estimate.scale,
        weakest=weak.direction,
        advice=weak.advice,
        placements=len(mine),
        residual_px=_of(found.checks.residual, camera).px,
        leave_one_out_px=left_out.px,
        leave_one_out_cm=left_out.cm,
        leave_one_out_as_read_px=as_read.px,
        leave_one_out_as_read_cm=as_read.cm,
    )


def _three(values: F8) -> tuple[float, float, float]:
    x, y, z = (float(v) for v in values)
    return x, y, z


def _of(misses: Mapping[tuple[str, str], Miss], camera: str) -> Miss:
    return together([miss for (_, seen_by), miss in misses.items() if seen_by == camera])


def _repeatability(found: Found, camera: str) -> Repeatability:
    spread = found.checks.spread[camera]
    held_out = together(
        [
            miss
            for (_, seen_by), misses in found.checks.held_out.items()
            if seen_by == camera
            for miss in misses
        ]
    )
    return Repeatability(
        camera=camera,
        halves=spread.halves,
        rotation_max_deg=float(np.degrees(spread.rotation_max_rad)),
        translation_max_m=spread.translation_max_m,
        rotation_rms_deg=float(np.degrees(spread.rotation_rms_rad)),
        translation_rms_m=spread.translation_rms_m,
        held_out_px=held_out.px if held_out.corners else None,
        held_out_cm=held_out.cm if held_out.corners else None,
    )


def _placements(found: Found, unseen: Mapping[str, str]) -> tuple[Placement, ...]:
    """Those in use, those left out, and those without a board, by name."""
    out = {name: Placement(name=name, used=False, reason=reason) for name, reason in unseen.items()}
    for p in found.everything.placements:
        sightings = tuple(_sighting(found, p.name, camera) for camera in sorted(p.images))
        used = any(s.used for s in sightings)
        T = found.estimate.T_lidar_board.get(p.name)
        away = p.cloud.T_lidar_board[:3, 3]
        tilt = np.degrees(
            np.arccos(np.clip(-p.cloud.T_lidar_board[:3, 2] @ away / np.linalg.norm(away), -1, 1))
        )
        out[p.name] = Placement(
            name=p.name,
            used=used,
            reason="" if used else next((s.reason for s in sightings if s.reason), ""),
            distance_m=float(np.linalg.norm(away)),
            tilt_deg=float(tilt),
            board_points=p.cloud.points,
            edge_points=p.cloud.edge_points,
            T_lidar_board=None if T is None else matrix(T),
            sightings=sightings,
        )
    return tuple(out.values())


def _sighting(found: Found, name: str, camera: str) -> Sighting:
    seen = next(p for p in found.everything.placements if p.name == name).images[camera]
    where = (name, camera)
    residual, left_out = found.checks.residual.get(where), found.checks.left_out.get(where)
    return Sighting(
        camera=camera,
        used=where not in found.left_out,
        reason=found.left_out.get(where, ""),
        corners=len(seen.pixels),
        corner_sigma_px=seen.sigma_px,
        residual_px=residual.px if residual else None,
        leave_one_out_px=left_out.px if left_out else None,
        leave_one_out_cm=left_out.cm if left_out else None,
    )


def judged(
    found: Found,
    certainty: tuple[Certainty, ...],
    repeatability: tuple[Repeatability, ...],
    settings: CalibrateSettings,
) -> tuple[bool, str]:
    """Whether the calibration is good, and why or why not, in a sentence."""
    doubts = []
    for c in certainty:
        if c.placements < _FEW:
            doubts.append(
                f"camera {c.camera} rests on {c.placements} placements, which leaves little to check it with"
            )
        if c.leave_one_out_cm > settings.good_cm or c.leave_one_out_px > settings.good_px:
            doubts.append(
                f"placements left out are predicted to {c.leave_one_out_px:.1f} px and {c.leave_one_out_cm:.2f} cm only "
                f"(camera {c.camera})"
            )
    for r in repeatability:
        if r.rotation_max_deg > settings.good_deg or r.translation_max_m > settings.good_m:
            doubts.append(
                f"calibrations from halves of the placements differ by up to {r.rotation_max_deg:.2f} degrees and "
                f"{100 * r.translation_max_m:.1f} cm (camera {r.camera})"
            )
    lost = {name for name, _ in found.left_out}
    if 2 * len(lost) > len(found.everything.placements):
        doubts.append(f"{len(lost)} of {len(found.everything.placements)} placements had to be left out")
    if doubts:
        return False, "; ".join(doubts)
    worst = max(certainty, key=lambda c: c.leave_one_out_cm)
    return True, (
        f"every placement left out is predicted, to {worst.leave_one_out_px:.1f} px and {worst.leave_one_out_cm:.2f} cm at worst "
        f"by camera, and {repeatability[0].halves if repeatability else 0} random halves agree"
    )


def _remarks(found: Found, settings: CalibrateSettings) -> list[str]:
    """What the LiDAR was found to be off by, where that is certain."""
    if settings.method == "paper" or settings.lidar == "believed":
        return []
    sensor, out = found.estimate.sensor, []
    for name, words in _SENSOR_WORDS.items():
        value, sigma = sensor.known(name)
        if abs(value) > _SURE * sigma:
            out.append(
                f"{words} by {1e3 * value:.1f} mm (sigma {1e3 * sigma:.1f} mm); the calibration allows for it"
            )
    return out


_SURE = 3.0
_SENSOR_WORDS = {
    "farther_m": "the LiDAR reads all ranges too long",
    "crossing_m": "the beams of the LiDAR do not start at its origin but cross before its axis",
    "darker_m": "the LiDAR reads dark print farther than bright print",
}


def metrics(found: Found, calibration: Calibration) -> list[Row]:
    """Rows of `metrics.json`: over all cameras, then camera by camera where there are several."""
    checks = found.checks
    rows = []

    def add(name: str, value: float | None, unit: str, method: str) -> None:
        if value is not None and np.isfinite(value):
            rows.append(
                {
                    "name": f"calibration.{name}",
                    "value": float(value),
                    "unit": unit,
                    "scope": "session",
                    "method": method,
                }
            )

    every = together(list(checks.left_out.values()))
    how = f"rms over {every.corners} corners: the LiDAR's board of each placement, by a calibration without that placement"
    add("leave_one_out_px", every.px, "px", f"{how}, projected")
    add("leave_one_out_cm", every.cm, "cm", f"{how}, against the corners' rays on the board's plane")
    as_read = together(list(checks.left_out_as_read.values()))
    add("leave_one_out_as_read_px", as_read.px, "px", "the same with the board where the cloud alone has it")
    held = together([m for misses in checks.held_out.values() for m in misses])
    add(
        "held_out_px",
        held.px if held.corners else None,
        "px",
        "the same by calibrations of random halves, on the other half",
    )
    add(
        "held_out_cm",
        held.cm if held.corners else None,
        "cm",
        "the same by calibrations of random halves, on the other half",
    )
    add(
        "residual_px",
        together(list(checks.residual.values())).px,
        "px",
        "rms, the LiDAR's boards by the calibration of all",
    )
    for r in calibration.repeatability:
        tail = f"; {r.halves} random halves against their mean, camera {r.camera}"
        add(f"{r.camera}.halves_max_deg", r.rotation_max_deg, "deg", f"largest turn{tail}")
        add(f"{r.camera}.halves_max_cm", 100 * r.translation_max_m, "cm", f"largest shift{tail}")
    for c in calibration.certainty:
        add(f"{c.camera}.sigma_deg", max(c.rotation_sigma_deg), "deg", "largest standard deviation of a turn")
        add(
            f"{c.camera}.sigma_mm",
            1e3 * max(c.translation_sigma_m),
            "mm",
            "largest standard deviation of a shift",
        )
        if len(calibration.certainty) > 1:
            add(f"{c.camera}.leave_one_out_px", c.leave_one_out_px, "px", "of this camera")
            add(f"{c.camera}.leave_one_out_cm", c.leave_one_out_cm, "cm", "of this camera")
    used = sum(p.used for p in calibration.placements)
    add("placements_used", used, "", f"of {len(calibration.placements)}")
    add("placements_left_out", len(calibration.placements) - used, "", f"of {len(calibration.placements)}")
    for name in SENSOR:
        value, sigma = found.estimate.sensor.known(name)
        add(
            f"lidar_{name.removesuffix('_m')}_mm",
            1e3 * value,
            "mm",
            f"what the LiDAR is off by; sigma {1e3 * sigma:.1f} mm",
        )
    add("good", float(calibration.verdict == "good"), "", calibration.reason)
    return rows
