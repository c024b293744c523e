"""Thin scans: their columns have no gaps, for kernels are compiled for such columns alone."""

from __future__ import annotations

import numpy as np
import pytest

from scanloom.schemas.scans import Scan
from scanloom.stages.geometry.neighbours import DENSE_POINTS, TARGET_POINTS, Points, ThinScan


def scattered(count: int) -> Scan:
    """Points all over a box of 60 m; the stamp of each is its row."""
    x, y, z = np.random.default_rng(0).uniform(-30, 30, (3, count)).astype(np.float32)
    return Scan(
        stamp_ns=np.arange(count, dtype=np.int64), x_m=x, y_m=y, z_m=z, intensity=np.zeros(count, np.float32),
        ring=np.zeros(count, np.uint16), return_no=np.zeros(count, np.uint8), reference_ns=count // 2, scan_index=0,
    )  # fmt: skip


def check(points: Points, scan: Scan) -> None:
    """Columns without gaps, and in each row one point of the scan with its own stamp."""
    rows = points.stamp_ns
    for found, whole in zip(points, (scan.stamp_ns, scan.x_m, scan.y_m, scan.z_m), strict=True):
        assert found.flags.c_contiguous
        assert found.dtype == whole.dtype
        np.testing.assert_array_equal(found, whole[rows])


@pytest.mark.parametrize(
    "rows", [slice(None, None, 3), slice(4, 40), slice(None, None, -1), np.arange(0, 60, 7)]
)
def test_taken_points_have_no_gaps(rows: slice | np.ndarray) -> None:
    scan = scattered(60)
    taken = Points(scan.stamp_ns, scan.x_m, scan.y_m, scan.z_m).take(rows)
    np.testing.assert_array_equal(taken.stamp_ns, scan.stamp_ns[rows])
    check(taken, scan)


@pytest.mark.parametrize("count", [500, 3 * TARGET_POINTS])
def test_thin_and_rough_scans_have_no_gaps(count: int) -> None:
    """Few points are all kept; of many some are left out when the scan is thinned, and again for the first guess."""
    scan = scattered(count)
    thin = ThinScan.of(scan)
    rough = thin.rough()
    for points in (thin.dense, thin.sparse, rough.dense, rough.sparse):
        check(points, scan)
    many = count > TARGET_POINTS
    assert (len(thin.dense.x_m) > DENSE_POINTS) == many
    assert (len(rough.dense.x_m) < len(thin.dense.x_m)) == many
