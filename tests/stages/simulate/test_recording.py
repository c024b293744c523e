"""The log is a real one, holds no truth, and is the same bytes again; truth fits it point by point."""

from __future__ import annotations

import hashlib

import numpy as np
from mcap.reader import make_reader

from scanloom.schemas.scans import PointClass
from scanloom.stages.simulate.stage import simulate
from tests.stages.simulate.conftest import SETTINGS, Recorded


def _digest(data: bytes) -> str:
    return hashlib.sha256(data).hexdigest()


def test_rosbags_reads_every_topic_at_its_rate(recorded: Recorded) -> None:
    seconds = SETTINGS.duration_s
    assert recorded.counts == {
        "/tf_static": 1,
        "/lidar/points": 10 * seconds,
        "/imu/data": 100 * seconds,
        "/wheel/twist": 50 * seconds,
        "/gnss/fix": 5 * seconds,
    }


def test_mcap_reads_it_in_order_of_reception(recorded: Recorded) -> None:
    with (recorded.log / "sample_0.mcap").open("rb") as stream:
        reader = make_reader(stream)
        summary = reader.get_summary()
        assert summary is not None
        assert summary.statistics is not None
        assert summary.statistics.message_count == sum(recorded.counts.values())
        times = [message.log_time for _, _, message in reader.iter_messages(log_time_order=False)]
    assert times == sorted(times)


def test_same_seed_same_bytes(recorded: Recorded) -> None:
    raw, truth = simulate(SETTINGS)
    for product, folder in ((raw, recorded.log), (truth, recorded.truth_folder)):
        for name in product.contents:
            assert _digest(product.read(name)) == _digest((folder / name).read_bytes()), name


def test_truth_names_every_point_in_order(recorded: Recorded) -> None:
    assert len(recorded.labels) == len(recorded.clouds)
    for cloud, label in zip(recorded.clouds, recorded.labels):
        assert len(cloud.points) == len(label.class_) == len(label.instance) > 2000
    kinds = np.concatenate([label.class_ for label in recorded.labels])
    share = {kind: float(np.mean(kinds == kind)) for kind in PointClass}
    assert share[PointClass.GROUND] > 0.15
    assert share[PointClass.STATIC] > 0.15
    assert 0.0 < share[PointClass.EGO] < 0.2
    assert 0.0 < share[PointClass.DYNAMIC] < 0.2
    dynamic = np.concatenate(
        [label.instance[label.class_ == PointClass.DYNAMIC] for label in recorded.labels]
    )
    assert (dynamic > 0).all()


def test_truth_is_not_in_the_log(recorded: Recorded) -> None:
    assert sorted(p.name for p in recorded.log.iterdir()) == ["metadata.yaml", "sample_0.mcap"]
    names = set(recorded.clouds[0].points.dtype.names or ())
    assert not names & {"class", "label", "instance"}
    assert not [topic for topic in recorded.counts if "truth" in topic or "odom" in topic]
    raw = (recorded.log / "sample_0.mcap").read_bytes()
    assert b"truth" not in raw
