"""The page in a browser: every plot is drawn and linked with the others, nothing is loaded, nothing complains."""

from __future__ import annotations

import base64
import json
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from scanloom.schemas.pose_graph import Graph
from scanloom.stages.geometry.geodesy import georeference
from scanloom.stages.report.page import compose
from scanloom.stages.report.run import Run, StageTime, run_section
from tests.browser import Page, chromium
from tests.stages.mapping import graph_of, loops_of, one, poses_of
from tests.stages.report.test_along import changes_of
from tests.stages.report.test_report import Map, body, graph_of_fixes

HOSTILE = "</script><img src=x onerror=document.title='caught'>"
DRAWN = "location.protocol === 'file:' && document.documentElement.classList.contains('drawn')"


@pytest.fixture(scope="module")
def written(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A report with every kind of plot."""
    world = Map()
    loops = loops_of(world.T, [(0, 4), (1, 4)], [0.0, 0.0])
    loops = replace(loops, accepted=np.array([True, False]), reason=np.array(["", HOSTILE], object))
    origin = georeference(48.1, 11.6, 520.0).model_dump()
    graph = Graph.concatenate([graph_of(loops), graph_of_fixes(world, [0.6, 0.8, 5.0])])
    files = world.report(
        loops=loops, graph=graph, poses=one(poses_of(world.T, georeference=origin)),
        tile_index=replace(world.index, georeference=origin, frame="world"), changes=changes_of([(10.0, 5.0, 40)]),
    )  # fmt: skip
    path = tmp_path_factory.mktemp("report") / "report.html"
    run = Run(
        [StageTime("deskew", 3, 2, 4.0, 310.4), StageTime("odometry", 1, 1, 2.0, 200.0)],
        facts={HOSTILE: HOSTILE},
    )
    path.write_text(compose(body(files), run_section(run), HOSTILE))
    return path


@pytest.fixture(scope="module")
def page(written: Path) -> Iterator[Page]:
    with chromium() as found:
        found.resize(1400, 1000)
        found.scheme("light")
        found.open(written.as_uri())
        found.wait(f"document.documentElement && {DRAWN}")
        yield found


def count(page: Page, selector: str) -> int:
    return int(page.run(f"document.querySelectorAll({json.dumps(selector)}).length"))


def test_every_plot_is_drawn_and_nothing_complains(page: Page) -> None:
    plots = count(page, "figure.plot")
    assert plots == 8
    assert count(page, "figure.plot svg.main-svg .xaxislayer-above") >= plots
    assert page.errors() == []
    assert {url.partition(":")[0] for url in page.requests()} <= {"file", "data", "blob"}
    assert page.run("document.title") != "caught"
    assert count(page, "img[src=x]") == 0


@pytest.mark.parametrize("width", [1400, 390])
def test_no_page_is_wider_than_its_window(page: Page, width: int) -> None:
    page.resize(width, 900)
    page.wait(f"document.querySelector('.plot .main-svg').clientWidth < {width}")
    assert page.run("document.documentElement.scrollWidth") <= width
    page.resize(1400, 1000)
    page.wait("document.querySelector('.plot-along .main-svg').clientWidth > 900")


def test_pointing_at_a_curve_marks_the_place_on_tracks_and_map(page: Page) -> None:
    assert page.run("getComputedStyle(document.querySelector('.here-spot')).display") == "none"
    page.run("document.querySelector('.plot-along').scrollIntoView({block: 'center'})")
    # The third of five scans, 16 m along x.
    box = page.run(
        "(() => { const area = document.querySelector('.plot-along .area'), full = area._fullLayout;"
        " const b = area.getBoundingClientRect(), y = area.data[0].y[2];"
        " return [b.x + full.xaxis._offset + full.xaxis.l2p(16), b.y + full.yaxis._offset + full.yaxis.l2p(y)]; })()"
    )
    page.command("Input.dispatchMouseEvent", type="mouseMoved", x=box[0], y=box[1])
    page.wait("getComputedStyle(document.querySelector('.here-spot')).display === 'block'")
    shown = "[...document.querySelectorAll('.here.KIND')].filter(m => m.style.display === 'block').length"
    assert page.run(shown.replace("KIND", "dot")) == 3
    assert page.run(shown.replace("KIND", "line")) == 3
    x = page.run(
        "(() => { const v = JSON.parse(document.getElementById('map').dataset.view);"
        " return Number(document.querySelector('.here-spot').getAttribute('cx')) * v.pixel_m + v.left_m; })()"
    )
    assert x == pytest.approx(16.0, abs=0.1)


def test_zooming_one_plot_along_the_way_zooms_the_others(page: Page) -> None:
    page.run("void Plotly.relayout(document.querySelector('.plot-along .area'), {'xaxis.range': [5, 9]})")
    ranges = page.run(
        "[...document.querySelectorAll('.plot-along .area')].map(a => a._fullLayout.xaxis.range)"
    )
    assert ranges == [[5, 9]] * 3


def test_tracks_are_coloured_by_what_is_chosen_and_lie_on_the_picture_chosen(page: Page) -> None:
    choose = "(() => {{ const s = document.querySelector('select.{0}'); s.value = '{1}'; s.dispatchEvent(new Event('change')); }})()"
    keys = page.run("[...document.querySelector('select.colours').options].map(o => o.value)")
    assert keys == ["error", "fix", "e1", "sigma", "speed", "height", ""]
    fills = []
    for key in ("error", "speed", ""):
        page.run(choose.format("colours", key))
        fills.append(
            page.run("[...document.querySelectorAll('.plot-plan .point')].map(p => p.style.fill).join()")
        )
    assert len(set(fills)) == 3
    page.run(choose.format("ground", "intensity"))
    page.wait("document.querySelectorAll('.plot-plan image').length === 1")
    assert page.errors() == []


def test_dark_pages_have_other_colours(page: Page) -> None:
    line = "getComputedStyle(document.querySelector('.plot-along .js-line')).stroke"
    light = page.run(line)
    page.scheme("dark")
    page.wait(f"{line} !== {json.dumps(light)}")
    page.scheme("light")
    page.wait(f"{line} === {json.dumps(light)}")


def test_paper_has_every_plot_and_no_controls(page: Page, written: Path) -> None:
    data = base64.b64decode(
        page.command("Page.printToPDF", printBackground=True, preferCSSPageSize=True)["data"]
    )
    assert data.startswith(b"%PDF")
    assert 2 <= data.count(b"/Type /Page\n") <= 15
    assert page.run("document.documentElement.classList.contains('paper')") is False
    assert page.errors() == []
