"""What is in the air on a drive, by the settings."""

from __future__ import annotations

from collections.abc import Sequence

from scanloom.stages.simulate.grains import Air
from scanloom.stages.simulate.motion import Motion
from scanloom.stages.simulate.plumes import dust_clouds, spray
from scanloom.stages.simulate.route import Path
from scanloom.stages.simulate.settings import Settings
from scanloom.stages.simulate.snow import Snow
from scanloom.stages.simulate.terrain import Plan
from scanloom.stages.simulate.traffic import Mover


def build_weather(settings: Settings, path: Path, motion: Motion, movers: Sequence[Mover]) -> list[Air]:
    """Nothing in the default settings; random numbers of its own, so that all else of a log stays as it is."""
    air: list[Air] = []
    if settings.snow_per_m > 0:
        covered = (0.0, 0.0) if settings.route == "estate" else Plan(settings.tunnel_m).tunnel
        air.append(Snow.of(settings.seed, settings.snow_per_m, settings.beams, covered))
    if settings.dust_clouds > 0:
        air.append(dust_clouds(settings, path, motion))
    if settings.spray_per_m > 0:
        air.append(spray(settings, path, motion, movers))
    return air
