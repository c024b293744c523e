"""A drive through a procedural town, recorded as a vehicle would: LiDAR, IMU, wheel speed and GNSS in one ROS 2 log.

The town has streets with houses, walls, poles, trees and bushes, parked and driving cars, a cyclist, pedestrians, a
tunnel, an open field, a bridge over a street, and is driven twice in the same and once in the opposite direction. The LiDAR
moves while it turns; ranges are noisy, returns are lost, dust rolls; the IMU has noise, bias and a lever arm; the wheels
slip and measure one per cent too much; GNSS fails in the tunnel and lies between high houses. A second world, the estate, has
parallel streets that look alike and one that repeats itself. Cameras, if asked for, see the same world in daylight: sun with
shadows, sky, bricks, worn markings, paint that mirrors, through lenses that bend, with an exposure that follows late, noise
and JPEG; things that move cast no shadow, and what is in the air is not drawn. The same seed gives the same bytes.
"""

from __future__ import annotations

from scanloom.schemas.session import RawLog, TruthLog
from scanloom.stages.simulate.settings import Settings

VERSION = 1

__all__ = ["VERSION", "Settings", "simulate"]


def simulate(settings: Settings) -> tuple[RawLog, TruthLog]:
    """Drive once; returns the log and, apart from it, the truth.

    RawLog: `sample_0.mcap` and `metadata.yaml`, a rosbag2 folder. TruthLog: `trajectory.parquet` (pose of the LiDAR at 100 Hz),
    `points.parquet` (class, instance and material of every point, in the order of the messages), `fixes.parquet` (where the
    antenna was at every fix, and which fixes lie), `objects.parquet` (boxes of parked cars and houses) and `tracks.parquet`
    (boxes of what moves, scan by scan); with cameras also `cameras.json` (where they truly are) and `colours.parquet` (albedo of
    every point, and whether the sun shines there). All are made in one drive, when the log is written.
    """
    from scanloom.stages.simulate.drive import Drive
    from scanloom.stages.simulate.recording import LOG_FILE

    drive = Drive(settings)
    log = RawLog(contents={LOG_FILE: drive.write_log, "metadata.yaml": drive.write_metadata})
    contents = {
        "trajectory.parquet": drive.write_trajectory,
        "points.parquet": drive.write_points,
        "fixes.parquet": drive.write_fixes,
        "objects.parquet": drive.write_objects,
        "tracks.parquet": drive.write_tracks,
    }
    if settings.cameras:
        contents |= {"cameras.json": drive.write_cameras, "colours.parquet": drive.write_colours}
    return log, TruthLog(contents=contents)
