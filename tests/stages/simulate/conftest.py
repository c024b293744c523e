"""One short drive, recorded once for all tests of the simulator."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray
from rosbags.highlevel import AnyReader
from rosbags.typesys import Stores, get_typestore

from scanloom.schemas.scans import TrueLabels, TruePoints
from scanloom.schemas.trajectory import Truth
from scanloom.stages.simulate.settings import Settings
from scanloom.stages.simulate.stage import simulate

SETTINGS = Settings(size="small", duration_s=6.0, columns=512, start_m=20.0)
LIDAR = "/lidar/points"
POINT = np.dtype(
    {
        "names": ["x", "y", "z", "intensity", "ring", "time"],
        "formats": ["<f4", "<f4", "<f4", "<f4", "<u2", "<f4"],
        "offsets": [0, 4, 8, 12, 16, 18],
        "itemsize": 22,
    }
)


@dataclass(frozen=True)
class Cloud:
    """One message: header stamp and points as recorded."""

    stamp_ns: int
    points: NDArray[np.void]

    @property
    def xyz(self) -> NDArray[np.float64]:
        return np.column_stack([self.points[axis] for axis in "xyz"]).astype(float)

    @property
    def point_ns(self) -> NDArray[np.int64]:
        return self.stamp_ns + np.round(self.points["time"].astype(float) * 1e9).astype(np.int64)


@dataclass(frozen=True)
class Recorded:
    """What a recorded drive holds, read back with a reader that is not ours."""

    log: Path
    truth_folder: Path
    counts: dict[str, int]
    clouds: list[Cloud]
    truth: Truth
    labels: list[TrueLabels]


@pytest.fixture(scope="session")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> Recorded:
    folder = tmp_path_factory.mktemp("drive")
    raw, truth = simulate(SETTINGS)
    raw.write(folder / "log")
    truth.write(folder / "truth")
    counts: dict[str, int] = {}
    clouds = []
    with AnyReader([folder / "log"], default_typestore=get_typestore(Stores.ROS2_HUMBLE)) as reader:
        for connection, _, data in reader.messages():
            message = reader.deserialize(data, connection.msgtype)
            counts[connection.topic] = counts.get(connection.topic, 0) + 1
            if connection.topic == LIDAR:
                stamp = message.header.stamp
                clouds.append(Cloud(stamp.sec * 10**9 + stamp.nanosec, message.data.view(POINT)))
    return Recorded(
        folder / "log",
        folder / "truth",
        counts,
        clouds,
        Truth.open(folder / "truth/trajectory.parquet"),
        list(TruePoints.open(folder / "truth/points.parquet")),
    )
