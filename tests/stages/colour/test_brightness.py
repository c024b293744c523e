"""Stretches of one session get one brightness, the session becomes grey; order does not matter."""

from __future__ import annotations

import numpy as np
import pytest

from scanloom.schemas.product import Parts
from scanloom.schemas.tiles import Colours, Paint
from scanloom.stages.colour import brightness
from scanloom.stages.colour.brightness import Settings
from scanloom.stages.colour.light import LUMINANCE


def paint(voxels: np.ndarray, factor: float) -> Paint:
    """What a stretch of its own brightness says of voxels whose light is known by their numbers."""
    weight = np.full(len(voxels), 2 * Paint.WEIGHT_STEPS, np.int64)
    light = np.rint(2.0 * factor * true_light(voxels) * Paint.LIGHT_STEPS).astype(np.int64)
    return Paint(
        voxel=voxels.astype(np.int64), weight=weight, light=light, views=np.full(len(voxels), 3, np.int32)
    )


def true_light(voxels: np.ndarray) -> np.ndarray:
    return np.column_stack([0.05 + 0.3 * ((voxels * k) % 101) / 101 for k in (7, 13, 29)])


def mean(colours: Colours) -> np.ndarray:
    return (colours.light / Colours.LIGHT_STEPS) / (colours.weight / Colours.WEIGHT_STEPS)[:, None]


def made(paints: dict[tuple[str, str], Paint], **settings: float) -> dict[str, Colours]:
    parts = Parts(
        [
            ((("session", "a"), ("footage", stretch), ("tile", tile)), one)
            for (stretch, tile), one in paints.items()
        ]
    )
    return {part.key: part.product for part in brightness(Settings(**settings), parts)}


CHAIN = {
    ("0000", "0_0"): paint(np.arange(0, 600), 1.0),
    ("0001", "0_0"): paint(np.arange(400, 900), 0.5),
    ("0001", "1_0"): paint(np.arange(0, 500), 0.5),
    ("0002", "1_0"): paint(np.arange(300, 800), 1.7),
}


def test_stretches_that_share_voxels_come_out_equally_bright() -> None:
    found = made(CHAIN)
    for tile, count in (("0_0", 900), ("1_0", 800)):
        assert np.array_equal(found[tile].voxel, np.arange(count))
        ratio = mean(found[tile]) / true_light(np.arange(count))
        assert ratio.std() / ratio.mean() < 1e-3
    assert found["0_0"].views[450] == 6 and found["0_0"].views[0] == 3


def test_the_session_is_grey() -> None:
    for grey in (0.18, 0.05):
        levels = np.concatenate([mean(each) @ LUMINANCE for each in made(CHAIN, grey=grey).values()])
        assert np.median(levels) == pytest.approx(grey, rel=0.05)


def test_too_few_shared_voxels_say_nothing() -> None:
    far = {("0000", "0_0"): paint(np.arange(0, 600), 1.0), ("0001", "0_0"): paint(np.arange(550, 900), 0.5)}
    for least, even in ((50, True), (51, False)):
        ratio = mean(made(far, least_shared=least)["0_0"]) / true_light(np.arange(900))
        assert (ratio[:500].mean() / ratio[650:].mean() < 1.01) == even


def test_order_does_not_matter_and_nothing_gives_nothing() -> None:
    one, other = made(CHAIN), made(dict(reversed(CHAIN.items())))
    assert all(np.array_equal(one[t].light, other[t].light) for t in one)
    assert made({}) == {}
