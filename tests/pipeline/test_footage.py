"""An axis that may have no part at all: a session without images is mapped as one with them."""

from __future__ import annotations

from pathlib import Path

import pytest

from scanloom.pipeline.plan import Request, plan
from scanloom.pipeline.run import run
from scanloom.pipeline.store import Store
from tests.pipeline.reading import verdicts
from tests.pipeline.toys.footage import WITH_FOOTAGE, Frames, Gallery, Lenses
from tests.pipeline.toys.products import Tile
from tests.pipeline.toys.workflow import log

SEEN, BLIND = range(30), range(1, 30, 2)


@pytest.mark.parametrize("cluster", ["none", "local"])
def test_no_session_with_images(cluster: str, tmp_path: Path, store: Store) -> None:
    asked = Request(WITH_FOOTAGE, (log(tmp_path, "a", BLIND),))
    result = run(asked, store, cluster=cluster, workers=1)
    assert not result.failures
    assert "tint" not in verdicts(result)
    assert result.files(Frames) == [] and result.parts(Lenses)[0].count == 0
    (gallery,) = result.parts(Gallery)
    assert gallery.frames == 0 and gallery.tints == {"0_0": 0, "1_0": 0, "2_0": 0}
    assert not any(tile.origins for tile in result.parts(Tile))
    again = run(asked, store, cluster="none")
    assert again.executed == 0 and not again.failures
    assert {task.verdict for task in plan(asked, store)} == {"HIT"}


def test_some_sessions_with_images(tmp_path: Path, store: Store) -> None:
    asked = Request(WITH_FOOTAGE, (log(tmp_path, "a", BLIND), log(tmp_path, "b", SEEN)))
    assert {task.verdict for task in plan(asked, store)} == {"RUN"}
    result = run(asked, store, cluster="none")
    assert not result.failures
    assert verdicts(result)["tint"].total() == 2
    (gallery,) = result.parts(Gallery)
    assert gallery.frames == 2 and gallery.tints == {"0_0": 5, "1_0": 5, "2_0": 5}
    tiles = {place["tile"]: tile for place, tile in result.parts(Tile).items()}
    assert list(tiles["1_0"].origins) == ["0000", "0001"] and len(tiles["1_0"]) == 5 + 10 + 5
