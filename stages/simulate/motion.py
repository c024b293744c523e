"""The true motion of the vehicle: one set of splines over time, from which everything is derived exactly."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.interpolate import BSpline, make_interp_spline
from scipy.ndimage import gaussian_filter1d

from scanloom.stages.geometry.se3 import F8, pose
from scanloom.stages.simulate.route import TICK_S, Path, progress
from scanloom.stages.simulate.settings import Settings

PITCH_PER_ACCEL, ROLL_PER_ACCEL = 0.008, 0.011
"""Suspension: rad of pitch and roll per m/s2."""
ROUGHNESS = ((7.3, 0.0020, 0.0030, 0.006), (3.1, 0.0012, 0.0016, 0.003), (1.9, 0.0008, 0.0008, 0.0015))
"""Rough road: wavelength m, amplitude of pitch rad, roll rad and heave m."""


@dataclass(frozen=True)
class Motion:
    """Pose of the base as a quintic spline of x, y, z, roll, pitch, yaw over time in seconds."""

    spline: BSpline
    first: BSpline
    second: BSpline
    arc: BSpline
    """Arc length of the path over time, m."""

    def poses(self, t: F8) -> F8:
        """T_world_base (n, 4, 4) at times t (n,) s."""
        c = self.spline(t)
        return pose(rotations(c[:, 3], c[:, 4], c[:, 5]), c[:, :3])

    def body_rates(self, t: F8) -> tuple[F8, F8]:
        """Angular velocity and angular acceleration (n, 3) in the base frame, rad/s and rad/s2."""
        c, d, e = self.spline(t), self.first(t), self.second(t)
        sr, cr, sp, cp = np.sin(c[:, 3]), np.cos(c[:, 3]), np.sin(c[:, 4]), np.cos(c[:, 4])
        dr, dp, dy = d[:, 3], d[:, 4], d[:, 5]
        ddr, ddp, ddy = e[:, 3], e[:, 4], e[:, 5]
        rate = np.column_stack((dr - dy * sp, dp * cr + dy * cp * sr, -dp * sr + dy * cp * cr))
        change = np.column_stack(
            (
                ddr - ddy * sp - dy * dp * cp,
                ddp * cr - dp * dr * sr + ddy * cp * sr - dy * dp * sp * sr + dy * dr * cp * cr,
                -ddp * sr - dp * dr * cr + ddy * cp * cr - dy * dp * sp * cr - dy * dr * cp * sr,
            )
        )
        return rate, change

    def acceleration(self, t: F8) -> F8:
        """Acceleration (n, 3) of the base's origin in the world, m/s2."""
        out: F8 = self.second(t)[:, :3]
        return out

    def velocity(self, t: F8) -> F8:
        """Velocity (n, 3) of the base's origin in the base frame, m/s."""
        R = self.poses(t)[:, :3, :3]
        out: F8 = np.einsum("nji,nj->ni", R, self.first(t)[:, :3])
        return out


def rotations(roll: F8, pitch: F8, yaw: F8) -> F8:
    """R = Rz(yaw) Ry(pitch) Rx(roll), (n, 3, 3)."""
    sr, cr, sp, cp, sy, cy = (
        np.sin(roll),
        np.cos(roll),
        np.sin(pitch),
        np.cos(pitch),
        np.sin(yaw),
        np.cos(yaw),
    )
    rows = [
        [cy * cp, cy * sp * sr - sy * cr, cy * sp * cr + sy * sr],
        [sy * cp, sy * sp * sr + cy * cr, sy * sp * cr - cy * sr],
        [-sp, cp * sr, cp * cr],
    ]
    return np.stack([np.stack(row, -1) for row in rows], -2)


def build_motion(settings: Settings, path: Path) -> Motion:
    """Drive the path: road slope, suspension and roughness give the attitude."""
    t, s = progress(settings, path)
    arc = make_interp_spline(t, s, k=5)
    p, d = path.at(s), path.at(s, 1)
    speed, accel = arc(t, nu=1), arc(t, nu=2)
    flat = np.hypot(d[:, 0], d[:, 1])
    blur = 0.12 / TICK_S
    pitch = -np.arctan2(d[:, 2], flat) - PITCH_PER_ACCEL * gaussian_filter1d(accel, blur)
    roll = np.arctan(path.cross_slope(np.mod(s, path.length_m)))
    roll = roll + ROLL_PER_ACCEL * gaussian_filter1d(speed**2 * path.curvature(s), blur)
    heave = np.zeros(len(t))
    for wavelength, dp, dr, dz in ROUGHNESS:
        phase = 2 * np.pi * s / wavelength
        pitch, roll = pitch + dp * np.sin(phase), roll + dr * np.sin(1.13 * phase + wavelength)
        heave += dz * np.cos(0.93 * phase)
    yaw = np.unwrap(np.arctan2(d[:, 1], d[:, 0]))
    channels = np.column_stack((p[:, :2], p[:, 2] + heave, roll, pitch, yaw))
    spline = make_interp_spline(t, channels, k=5)
    return Motion(spline, spline.derivative(1), spline.derivative(2), arc)
