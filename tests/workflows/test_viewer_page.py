"""The page of the viewer in a browser without a screen: what is seen, picked, measured, and that nothing leaves the machine."""

from __future__ import annotations

import io
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from scanloom.stages.geometry.geodesy import world_to_projected
from scanloom.workflows.viewer.server import Server
from tests.browser import Page, chromium
from tests.viewed import ORIGIN, POINTS, Running, make_map, paint, removed_places, scene

pytestmark = pytest.mark.slow
WIDTH, HEIGHT = 1000, 700
READY = "window.scanloom && scanloom.cloud.shown > 0 && !scanloom.cloud.busy && !scanloom.dirty && !scanloom.stale"
REMOVED = 3_000
ACROSS = (
    "[...document.querySelectorAll('#card dt')].map((d, i) => [d.textContent, d.nextSibling.textContent])"
)


@pytest.fixture(scope="module")
def server(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Server]:
    folder = tmp_path_factory.mktemp("page") / "m"
    make_map(folder, removed=REMOVED)
    with Running(folder) as running:
        yield running


@pytest.fixture(scope="module")
def page(server: Server) -> Iterator[Page]:
    with chromium() as tab:
        tab.resize(WIDTH, HEIGHT)
        tab.open(server.url)
        tab.wait(READY)
        yield tab


@pytest.fixture(autouse=True)
def _quiet(page: Page) -> Iterator[None]:
    """No test leaves an error in the console, or asks another machine for anything."""
    yield
    assert page.errors() == []
    here = page.run("location.origin")
    assert {
        url.split("/data/")[0] for url in page.requests() if not url.startswith((here, "data:", "blob:"))
    } == set()


def pixels(page: Page) -> np.ndarray:
    """(height, width, 3) of the picture right of the panel, after what is under way is drawn."""
    page.wait(READY)
    page.run("new Promise((done) => requestAnimationFrame(() => requestAnimationFrame(done)))")
    picture = np.asarray(Image.open(io.BytesIO(page.picture())).convert("RGB")).astype(int)
    return picture[60:-60, 320:]


def changed(before: np.ndarray, after: np.ndarray) -> float:
    """Share of the pixels that differ."""
    return float((np.abs(before - after).max(axis=2) > 12).mean())


def test_points_are_seen(page: Page) -> None:
    picture = pixels(page)
    empty = picture[0, -1]
    assert 0.05 < (np.abs(picture - empty).max(axis=2) > 12).mean() < 0.98
    assert page.run("document.getElementById('name').textContent") == "Old town"
    assert "EPSG:32632" in page.run("document.getElementById('crs').textContent")
    assert page.run("document.getElementById('message').hidden")


def test_each_colour_is_another_picture(page: Page) -> None:
    seen = []
    for key in "1234":
        page.key(key)
        seen.append(pixels(page))
    for i, one in enumerate(seen):
        for other in seen[:i]:
            assert changed(one, other) > 0.1
    page.run("scanloom.colour('class')")
    legend = page.run("document.getElementById('legend').textContent")
    assert "ground" in legend and "static" in legend
    page.key("1")


def test_layers_come_and_go(page: Page) -> None:
    for layer, least in (
        ("points", 0.05),
        ("trajectories", 0.001),
        ("loops", 0.0005),
        ("objects", 0.0003),
        ("removed", 0.005),
    ):
        on = pixels(page)
        page.run(f"document.querySelector('[data-layer={layer}]').click()")
        if layer == "points":
            page.wait("scanloom.cloud.shown === 0 && !scanloom.dirty && !scanloom.stale")
            page.run("new Promise((done) => setTimeout(done, 300))")
            off = np.asarray(Image.open(io.BytesIO(page.picture())).convert("RGB")).astype(int)[60:-60, 320:]
        else:
            page.wait("!scanloom.removed || !scanloom.removed.busy")
            off = pixels(page)
        assert changed(on, off) > least, layer
        page.run(f"document.querySelector('[data-layer={layer}]').click()")
        pixels(page)
    counts = page.run("[...document.querySelectorAll('#layers small')].map((s) => s.textContent)")
    assert counts == ["30 000", "1", "1", "1", "3 000"]


def test_all_points_can_be_loaded_and_are_those_of_the_map(page: Page) -> None:
    page.run("scanloom.use(true); scanloom.fit(); scanloom.setBudget(8); scanloom.cloud.everything()")
    page.run(
        "scanloom.view.top.zoom = 0.7; scanloom.view.top.updateProjectionMatrix(); scanloom.dirty = true"
    )
    page.wait(f"scanloom.cloud.shown === {POINTS}", 90)
    assert page.run("scanloom.cloud.loaded") == POINTS
    page.wait(READY)
    assert page.run("document.getElementById('count').textContent").startswith("30 000 of 30 000")
    heights = page.run(
        "[...scanloom.cloud.parts()].flatMap((p) => { const a = p.geometry.attributes._intensity;"
        " return Array.from({length: a.count}, (_, i) => a.getX(i)); })"
    )
    assert np.array_equal(
        np.sort(np.array(heights, np.float32)), np.linspace(0, 60, POINTS).astype(np.float32)
    )


@pytest.mark.parametrize("top", [True, False])
def test_a_known_point_is_picked_where_it_is(page: Page, top: bool) -> None:
    page.run(f"scanloom.use({str(top).lower()}); scanloom.fit(); scanloom.clear()")
    page.wait(READY)
    rng = np.random.default_rng(5)
    points, found = scene(), 0
    in_front = np.flatnonzero(points[:, 1] < 11.0)  # of the wall, seen from the south
    for row in rng.choice(in_front, 12, replace=False):
        x, y, z = points[row]
        at = page.run(
            f"(() => {{ const V = scanloom.low.constructor; return scanloom.view.project(new V({x}, {y}, {z})); }})()"
        )
        if not at or not (340 < at["x"] < WIDTH - 20 and 80 < at["y"] < HEIGHT - 80):
            continue
        page.run("scanloom.about = null; scanloom.clear()")
        page.click(at["x"], at["y"])
        page.wait("scanloom.about")
        about = page.run("scanloom.about")
        # Another point may lie nearer under the same pixel; it is then within the size of a few pixels.
        metres = 7.0 * page.run(
            "scanloom.view.isTop ? 1 / scanloom.view.perMetre : 100 / scanloom.view.perMetre"
        )
        off = np.array(about["map_m"]) - points[row]
        assert np.hypot(off[0], off[1]) < metres
        easting, northing, height = world_to_projected(ORIGIN, np.array(about["map_m"]))[0]
        assert about["easting_m"] == pytest.approx(easting, abs=1e-3)
        assert about["northing_m"] == pytest.approx(northing, abs=1e-3)
        assert about["height_m"] == pytest.approx(height, abs=1e-3)
        assert points[np.abs(points - about["map_m"]).sum(axis=1).argmin()] == pytest.approx(
            about["map_m"], abs=1e-3
        )
        found += 1
    assert found >= 4
    card = dict(page.run(ACROSS))
    assert (
        card["Session"] == "drive"
        and card["Class"] in ("ground", "static")
        and card["Easting"].endswith(" m")
    )
    page.key("Escape")
    assert page.run("document.getElementById('card').hidden")


def test_a_point_seen_close_is_picked_exactly(page: Page) -> None:
    page.run("scanloom.use(true); scanloom.fit()")
    x, y, z = scene()[-10]  # of the wall, from above
    page.run(
        f"(() => {{ const v = scanloom.view; v.control.target.set({x}, {y}, 0); v.top.position.set({x}, {y}, 300);"
        " v.top.zoom = 900; v.top.updateProjectionMatrix(); v.control.update(); scanloom.dirty = true; scanloom.about = null; })()"
    )
    page.wait(READY)
    page.click(WIDTH / 2, HEIGHT / 2)
    page.wait("scanloom.about")
    off = np.array(page.run("scanloom.about.map_m")) - (x, y, z)
    assert np.hypot(off[0], off[1]) < 0.02
    page.key("Escape")
    page.run("scanloom.fit()")


def test_distances_are_measured(page: Page) -> None:
    page.run("scanloom.use(true); scanloom.fit()")
    page.wait(READY)
    page.key("m")
    assert page.run("document.getElementById('measure').getAttribute('aria-pressed')") == "true"
    for x, y in ((500, 300), (700, 300), (700, 450)):
        page.click(x, y)
    corners = np.array(page.run("scanloom.overlay.line.map((p) => [p.x, p.y, p.z])"))
    assert len(corners) == 3
    card = dict(page.run(ACROSS))
    steps = np.diff(corners, axis=0)
    assert card["Length"] == f"{np.linalg.norm(steps, axis=1).sum():.3f} m"
    assert card["On the plane"] == f"{np.linalg.norm(steps[:, :2], axis=1).sum():.3f} m"
    assert card["Height difference"] == f"{corners[2, 2] - corners[0, 2]:.3f} m"
    metres = 350.0 / page.run("scanloom.view.perMetre")
    assert np.linalg.norm(steps[:, :2], axis=1).sum() == pytest.approx(metres, rel=0.08)
    page.key("Escape")
    assert page.run("scanloom.overlay.line.length") == 0


def test_a_removed_point_is_picked_and_says_why(page: Page) -> None:
    page.run("scanloom.use(true); scanloom.fit(); scanloom.clear()")
    page.run("document.querySelector('[data-layer=removed]').click()")
    page.run("document.querySelector('[data-layer=points]').click()")
    page.wait(
        "scanloom.removed && scanloom.removed.shown > 0 && !scanloom.removed.busy && !scanloom.dirty && !scanloom.stale"
    )
    places, found = removed_places(REMOVED), 0
    for x, y, z in places[::250]:
        at = page.run(
            f"(() => {{ const V = scanloom.low.constructor; return scanloom.view.project(new V({x}, {y}, {z})); }})()"
        )
        if not (340 < at["x"] < WIDTH - 20 and 80 < at["y"] < HEIGHT - 80):
            continue
        page.run("scanloom.about = null; scanloom.clear()")
        page.click(at["x"], at["y"])
        page.wait("scanloom.about")
        about = page.run("scanloom.about")
        assert about["class"] == "dynamic" and "moved" in about["why"]
        assert np.abs(places - about["map_m"]).max(axis=1).min() < 1e-3
        found += 1
    assert found >= 4
    assert "moved" in dict(page.run(ACROSS))["Left out since"]
    page.key("Escape")
    page.run("document.querySelector('[data-layer=removed]').click()")
    page.run("document.querySelector('[data-layer=points]').click()")


def test_cameras_are_offered_only_where_they_saw_something(page: Page, tmp_path: Path) -> None:
    assert page.run("document.querySelector('[data-mode=camera]')") is None
    make_map(tmp_path / "m")
    paint(tmp_path / "m")
    with Running(tmp_path / "m") as server, chromium() as tab:
        tab.resize(WIDTH, HEIGHT)
        tab.open(server.url)
        tab.wait(READY)
        tab.run("document.querySelector('[data-mode=camera]').click()")
        tab.run("scanloom.use(true); scanloom.fit()")
        tab.run("document.getElementById('shading').click()")
        picture = pixels(tab)
        blue = (picture[:, :, 2] > 200) & (picture[:, :, 1] < 30)
        columns = np.flatnonzero(blue.any(axis=0))
        assert 0.02 < blue.mean() < 0.6 and columns.min() > picture.shape[1] * 0.4
        red = [picture[:, c, 0][blue[:, c]].mean() for c in (columns[5], columns[-5])]
        assert red[0] < 40 and red[1] > 150
        assert tab.errors() == []


def test_budget_bounds_what_is_shown(page: Page) -> None:
    page.run("scanloom.setBudget(Math.log10(8000))")
    page.wait("scanloom.cloud.shown < 10000 && scanloom.cloud.shown > 1000", 60)
    page.run("scanloom.setBudget(8)")
    page.wait(f"scanloom.cloud.shown > {POINTS // 2}", 60)


def test_it_fits_a_phone(page: Page) -> None:
    page.resize(390, 844, phone=True)
    page.run("new Promise((done) => setTimeout(done, 300))")
    wide = page.run("[document.documentElement.scrollWidth, innerWidth]")
    assert wide[0] <= wide[1] == 390
    for name in ("panel", "tools", "status"):
        box = page.run(
            f"(() => {{ const b = document.getElementById('{name}').getBoundingClientRect(); return [b.left, b.right]; }})()"
        )
        assert 0 <= box[0] < box[1] <= 390, name
    boxes = [
        page.run(f"document.getElementById('{name}').getBoundingClientRect().toJSON()")
        for name in ("tools", "status")
    ]
    assert boxes[1]["right"] <= boxes[0]["left"] or boxes[1]["top"] >= boxes[0]["bottom"]
    page.resize(WIDTH, HEIGHT)


def test_without_webgl_the_page_says_so(server: Server) -> None:
    with chromium("--disable-gpu", "--disable-3d-apis") as tab:
        tab.open(server.url)
        tab.wait("document.getElementById('message')?.hidden === false")
        assert "WebGL 2" in tab.run("document.getElementById('message').textContent")
