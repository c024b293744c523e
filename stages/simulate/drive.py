"""One drive: the town, the motion, the sensors, and the log they make."""

from __future__ import annotations

import zlib
from collections.abc import Iterator, Sequence
from typing import IO

import numpy as np

from scanloom.schemas.scans import TrueLabels, TruePoints
from scanloom.schemas.simulated import TrueColours, TruePaint
from scanloom.schemas.trajectory import Truth
from scanloom.stages.geometry.geodesy import georeference
from scanloom.stages.simulate.busy import build_guests, giving_way
from scanloom.stages.simulate.cameras import NAMES, optical, told_mounts, true_cameras
from scanloom.stages.simulate.estate import build_estate
from scanloom.stages.simulate.footage import Footage
from scanloom.stages.simulate.gnss import GnssTrack, gnss_track
from scanloom.stages.simulate.motion import Motion, build_motion
from scanloom.stages.simulate.paints import Paints
from scanloom.stages.simulate.pictures import camera_entries, camera_topics
from scanloom.stages.simulate.recording import TYPES, Recorder, entries
from scanloom.stages.simulate.rig import T_BASE
from scanloom.stages.simulate.route import build_path, ring
from scanloom.stages.simulate.settings import Settings
from scanloom.stages.simulate.sweeping import Lidar, Sweep, scene_of
from scanloom.stages.simulate.town import Town, build_town
from scanloom.stages.simulate.tracks import imu_track, wheel_track
from scanloom.stages.simulate.traffic import CONVOY, Mover, build_traffic
from scanloom.stages.simulate.truths import true_fixes, true_objects, true_tracks
from scanloom.stages.simulate.weather import build_weather

SETTLED = "simulated: exact"


class Drive:
    """One drive; keeps of every sweep only what its points truly are, compressed."""

    def __init__(self, settings: Settings) -> None:
        self.settings = settings
        self._recorder = Recorder({**TYPES, **camera_topics(settings)})
        self._labels: list[list[bytes]] = []
        self._colours: list[list[bytes]] = []
        self._motion: Motion | None = None
        self._gnss: GnssTrack | None = None
        self._town_driven: Town | None = None
        self._movers: Sequence[Mover] = ()

    def write_log(self, stream: IO[bytes]) -> None:
        s = self.settings
        town = self._town()
        path = town.path
        motion = build_motion(s, path)
        movers = self._movers_of(town, motion)
        footage = Footage(s, town, motion, movers, Paints(s.town_seed)) if s.cameras else None
        lidar = Lidar(s, town, motion, movers, build_weather(s, path, motion, movers), footage)
        gnss_settings = s if s.gnss else s.model_copy(update={"duration_s": 0.0})
        gnss = gnss_track(gnss_settings, motion, scene_of(town.triangles()[0]))
        sweeps = self._noting_truth(lidar.sweeps())
        start_ns = s.start_s * 1_000_000_000
        frames = {name: T for name, T in T_BASE.items() if name != "gnss" or s.gnss_lever_arm_known}
        frames |= {optical(name): T for name, T in zip(NAMES, told_mounts(s))}
        images = camera_entries(s, footage.shots()) if footage else iter(())
        imu, wheel = imu_track(s, motion), wheel_track(s, motion)
        self._recorder.record(stream, entries(start_ns, sweeps, imu, wheel, gnss, frames, images))
        self._motion, self._gnss, self._town_driven, self._movers = motion, gnss, town, movers

    def _town(self) -> Town:
        """The world with the path that is driven in it."""
        s = self.settings
        if s.route == "estate":
            return build_estate(s.town_seed, s.parking_seed)
        town = build_town(s.town_seed, s.parking_seed, s.tunnel_m)
        if s.route == "roundabout":
            town.path = build_path(ring(), town.terrain)
        return town

    def _movers_of(self, town: Town, motion: Motion) -> list[Mover]:
        """Everybody on the road; on a busy day more, and the others give way."""
        actors = build_traffic(self.settings, town.path, motion)
        if not self.settings.busy:
            return [*actors]
        convoy = [actor for actor in actors if actor.name in CONVOY]
        guests = build_guests(self.settings, town, motion, convoy)
        return [*giving_way(self.settings, town.path, actors, guests), *guests]

    def write_metadata(self, stream: IO[bytes]) -> None:
        stream.write(self._recorder.metadata())

    def write_trajectory(self, stream: IO[bytes]) -> None:
        motion = self._driven()
        t = np.arange(int(self.settings.duration_s * 100) + 1) / 100
        stamps = self.settings.start_s * 1_000_000_000 + np.round(t * 1e9).astype(np.int64)
        origin = georeference(self.settings.latitude_deg, self.settings.longitude_deg, self.settings.height_m)
        Truth(stamps, motion.poses(t) @ T_BASE["lidar"], SETTLED, origin.model_dump()).write_to(stream)

    def write_points(self, stream: IO[bytes]) -> None:
        self._driven()
        TruePoints(self._true_labels()).write_to(stream)

    def write_fixes(self, stream: IO[bytes]) -> None:
        self._driven()
        assert self._gnss is not None  # noqa: S101  (write_log sets it)
        true_fixes(self.settings.start_s, self._gnss).write_to(stream)

    def write_objects(self, stream: IO[bytes]) -> None:
        self._driven()
        assert self._town_driven is not None  # noqa: S101  (write_log sets it)
        true_objects(self._town_driven.things).write_to(stream)

    def write_tracks(self, stream: IO[bytes]) -> None:
        self._driven()
        town = self._town_driven
        assert town is not None  # noqa: S101  (write_log sets it)
        seen = [label.instance for label in self._true_labels()]
        true_tracks(self.settings, town.path, self._movers, town.instances, seen).write_to(stream)

    def write_cameras(self, stream: IO[bytes]) -> None:
        """Where the cameras truly are."""
        stream.write(true_cameras(self.settings).model_dump_json(indent=1).encode() + b"\n")

    def write_colours(self, stream: IO[bytes]) -> None:
        """What colour every point has."""
        self._driven()
        TrueColours(self._true_colours()).write_to(stream)

    def _true_colours(self) -> Iterator[TruePaint]:
        for index, (albedo, lit) in enumerate(self._colours):
            yield TruePaint(
                np.frombuffer(zlib.decompress(albedo), np.uint8).reshape(-1, 3),
                np.frombuffer(zlib.decompress(lit), np.bool_).astype(np.uint8),
                scan_index=index,
            )

    def _driven(self) -> Motion:
        """The motion, after the log was written."""
        if self._motion is None:
            import io

            self.write_log(io.BytesIO())
        assert self._motion is not None  # noqa: S101  (write_log sets it)
        return self._motion

    def _noting_truth(self, sweeps: Iterator[Sweep]) -> Iterator[Sweep]:
        self._labels, self._colours = [], []
        for sweep in sweeps:
            truth = (sweep.kind, sweep.instance, sweep.material)
            self._labels.append([zlib.compress(column.tobytes(), 1) for column in truth])
            if sweep.albedo is not None and sweep.lit is not None:
                self._colours.append([zlib.compress(c.tobytes(), 1) for c in (sweep.albedo, sweep.lit)])
            yield sweep

    def _true_labels(self) -> Iterator[TrueLabels]:
        for index, (kind, instance, material) in enumerate(self._labels):
            yield TrueLabels(
                np.frombuffer(zlib.decompress(kind), np.uint8),
                np.frombuffer(zlib.decompress(instance), np.uint16),
                np.frombuffer(zlib.decompress(material), np.uint8),
                scan_index=index,
            )
