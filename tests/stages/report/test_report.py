"""The report: deterministic bytes, sane pages for odd maps, a verdict that follows the figures."""

from __future__ import annotations

import base64
import hashlib
import html
import io
import json
import re
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from PIL import Image

from scanloom.schemas.cameras import Camera, CameraAgreement, CameraCheck, CameraModel, Cameras, Footage
from scanloom.schemas.evaluation import ErrorTrack, Metrics, ReportFiles
from scanloom.schemas.loops import Loops
from scanloom.schemas.pose_graph import Graph
from scanloom.schemas.product import Parts
from scanloom.schemas.rig import SensorCheck, WheelCheck
from scanloom.schemas.session import Problem, Session, Topic
from scanloom.schemas.tiles import Tile, TileIndex
from scanloom.schemas.tracks import Gnss
from scanloom.schemas.trajectory import Poses
from scanloom.stages.evaluation import evaluation
from scanloom.stages.evaluation.stage import Settings as EvaluationSettings
from scanloom.stages.geometry.geodesy import georeference
from scanloom.stages.report import picture, report
from scanloom.stages.report.map_picture import Settings as PictureSettings
from scanloom.stages.report.page import compose
from scanloom.stages.report.run import Run, run_section
from scanloom.stages.report.stage import Settings
from scanloom.stages.report.templates import asset
from scanloom.stages.tiling import overview
from scanloom.stages.tiling.overview import Settings as OverviewSettings
from tests.stages.mapping import (
    Source,
    fixes_graph,
    graph_of,
    loops_of,
    odometry_of,
    one,
    pieces_of,
    poses_of,
    session_of,
    tile_parts,
    tiles_of,
    truth_of,
)
from tests.stages.report.parsing import parse
from tests.stages.report.test_along import changes_of
from tests.worlds import drive, street

DRAWN = ("poses", "loops", "graph", "tile_index", "tiles")


class Map:
    """A mapped street and what the report reads of it; any product can be replaced."""

    def __init__(self) -> None:
        self.scans, self.T = drive(street(), 5, step_m=8.0)
        self.tiles = tile_parts(tiles_of([Source("a", "0000", pieces_of(self.scans, self.T))]))
        self.index, _, _ = overview(OverviewSettings(), self.tiles)

    def report(self, **changed: Any) -> ReportFiles:
        given: dict[str, Any] = {
            "session": one(session_of(scans=5)), "metrics": None, "error_track": None, "poses": one(poses_of(self.T)),
            "odometry": one(odometry_of(self.T)), "loops": Loops.empty(), "tile_index": self.index, "tiles": self.tiles,
            **changed,
        }  # fmt: skip
        given.setdefault("graph", graph_of(given["loops"]))
        self.drawn = picture(PictureSettings(longest_px=400), **{name: given[name] for name in DRAWN})
        if given["metrics"] is None:
            given["metrics"], given["error_track"] = self.evaluate(given)
        del given["tiles"]
        return report(Settings(), picture=self.drawn, **given)

    def evaluate(self, given: dict[str, Any]) -> tuple[Metrics, Parts[ErrorTrack]]:
        *tracks, metrics = evaluation(
            EvaluationSettings(), given["session"], one(truth_of(self.T)),
            given["odometry"], given["poses"], given["loops"], given["graph"], one(Gnss.empty()), given["tiles"],
        )  # fmt: skip
        return metrics, Parts([((("session", part.key),), part.product) for part in tracks])  # type: ignore[return-value, union-attr]


@pytest.fixture(scope="module")
def street_map() -> Map:
    return Map()


def body(files: ReportFiles) -> str:
    return files.read("body.html").decode()


def test_the_same_map_gives_the_same_bytes(street_map: Map) -> None:
    one_, drawn = street_map.report(), street_map.drawn
    assert one_.read("body.html") == street_map.report().read("body.html")
    for name in drawn.contents:
        assert drawn.read(name) == street_map.drawn.read(name)


def test_the_page_is_one_file_without_outside_references(street_map: Map) -> None:
    page = compose(body(street_map.report()), run_section(Run()), "street")
    parser = parse(page)
    assert parser.addresses
    assert all(address.startswith("data:") for address in parser.addresses)
    own = page.replace(asset("vendor/plotly-basic.min.js"), "")
    assert "@import" not in own
    assert "url(" not in own
    assert set(re.findall(r"https?://[^\"'\s<]+", own)) <= {"http://www.w3.org/2000/svg"}
    assert 20_000 < len(own) < 1_000_000
    assert len(page) < 2_500_000


def test_scripts_of_the_page_are_those_its_policy_names(street_map: Map) -> None:
    page = compose(body(street_map.report()), run_section(Run()), "street")
    policy = re.search(r'http-equiv="Content-Security-Policy" content="([^"]+)"', page)
    assert policy is not None
    told = html.unescape(policy[1])
    assert told.startswith("default-src 'none'; ")
    scripts = re.findall(r"<script>(.*?)</script>", page, re.DOTALL)
    assert len(scripts) == 2
    for script in scripts:
        digest = base64.b64encode(hashlib.sha256(script.encode()).digest()).decode()
        assert f"'sha256-{digest}'" in told
    assert "unsafe-eval" not in told
    assert told.count("'unsafe-inline'") == 1
    assert "script-src 'sha256" in told


def test_every_plot_is_valid_json(street_map: Map) -> None:
    loops = loops_of(street_map.T, [(0, 4), (1, 4)], [0.0, 0.0])
    plots = plots_of(body(street_map.report(loops=loops, changes=changes_of([(10.0, 5.0, 9)]))))
    assert [plot["kind"] for plot in plots] == ["plan", "along", "along", "plan", "plan"]
    for plot in plots:
        assert plot["data"]
        for trace in plot["data"]:
            assert len(trace["x"]) == len(trace["y"])


def plots_of(page: str) -> list[dict[str, Any]]:
    return [json.loads(text) for text in re.findall(r'<script type="application/json">(.*?)</script>', page)]


HOSTILE = "</script><img src=x onerror=alert(1)><!--\u2028"


def test_hostile_names_of_sessions_reach_neither_tags_nor_scripts(street_map: Map) -> None:
    names = [HOSTILE, "b"]
    sessions: Parts[Session] = Parts([((("session", n),), session_of(n, 5)) for n in names])
    poses: Parts[Poses] = Parts([((("session", n),), poses_of(street_map.T)) for n in names])
    odometry = Parts([((("session", n),), odometry_of(street_map.T)) for n in names])
    loops = replace(loops_of(street_map.T, [(0, 4)], [0.0]), session_i=np.array([HOSTILE], object))
    loops = replace(loops, session_j=np.array(["b"], object))
    given = {"session": sessions, "poses": poses, "odometry": odometry, "loops": loops}
    page = body(street_map.report(**given, metrics=Metrics.empty(), error_track=Parts([])))
    assert "<img src=x" not in page
    assert "<!--" not in page
    assert page.count("</script>") == page.count("<script type=")
    parse(page)
    tracks = plots_of(page)[0]
    assert set(tracks["beads"]) == set(names)
    shown = [trace["name"] for trace in tracks["data"]]
    assert not any("<" in name for name in shown)
    assert html.unescape(shown[0]) == HOSTILE


def test_a_good_map_is_called_good_and_says_why(street_map: Map) -> None:
    text = parse(body(street_map.report())).text
    assert "Good" in text
    assert "5 of 5 scans registered" in text
    assert "within 0.00 m of truth" in text
    assert "Not georeferenced" in text


def test_the_picture_shows_walls_ground_and_emptiness(street_map: Map) -> None:
    street_map.report()
    image = np.asarray(Image.open(io.BytesIO(street_map.drawn.read("preview.png"))))
    assert 300 <= max(image.shape[:2]) <= 420
    dark = (image.astype(int).sum(axis=2) < 70).mean()
    assert 0.1 < dark < 0.95
    assert len(np.unique(image.reshape(-1, 3), axis=0)) > 500


def test_gnss_agreement_is_measured_and_drawn(street_map: Map) -> None:
    origin = georeference(48.1, 11.6, 520.0)
    poses = poses_of(street_map.T, georeference=origin.model_dump())
    index = replace(street_map.index, georeference=origin.model_dump(), frame="world")
    near = body(
        street_map.report(
            poses=one(poses), tile_index=index, graph=graph_of_fixes(street_map, [0.6, 0.8, 5.0])
        )
    )
    assert "agree to 1.00 m" in near
    assert "GNSS fix" in near
    assert f"EPSG:{origin.epsg}" in near
    far = body(street_map.report(poses=one(poses), graph=graph_of_fixes(street_map, [40, 0, 0])))
    assert "Poor" in parse(far).text


def graph_of_fixes(street_map: Map, off_m: list[float], verdicts: list[str] | None = None) -> Graph:
    """A fix for each of the five scans, so far from it."""
    off = np.tile(np.array(off_m, float), (5, 1))
    return fixes_graph(street_map.T[:, :3, 3] + off, -off, verdicts or ["used"] * 5)


def test_false_loops_spoil_the_verdict(street_map: Map) -> None:
    loops = loops_of(street_map.T, [(0, 4)], [5.0])
    text = parse(body(street_map.report(loops=loops))).text
    assert "Poor" in text
    assert "100.0 % of the accepted loops are wrong" in text


def test_problems_of_the_log_reach_the_page_and_are_escaped(street_map: Map) -> None:
    topic = Topic(
        name="/<script>alert(1)</script>",
        type="x",
        role="lidar",
        messages=5,
        rate_hz=10.0,
        first_ns=0,
        last_ns=1,
    )
    problem = Problem(code="imu.gap", severity="error", text="silent for <b>2 s</b>", topic="/imu")
    session = session_of("a", 5, topics=(topic,), problems=(problem,), complete=False)
    page = compose(
        body(street_map.report(session=one(session))), run_section(Run(facts={"<i>": "<u>"})), "<title>"
    )
    assert "<script>alert" not in page
    assert "<b>2 s" not in page
    assert "<dt><i>" not in page
    text = parse(page).text
    assert "Fair" in text
    assert "silent for <b>2 s</b>" in text
    assert "the log is incomplete" in text


def test_no_truth_no_tiles_one_scan_still_give_a_page(street_map: Map) -> None:
    nothing = Metrics.empty()
    index = TileIndex.empty(frame="map", georeference=None, tile_size_m=50.0, voxel_size_m=0.1)
    empty: Parts[Tile] = Parts([])
    one_scan = poses_of(street_map.T[:1])
    for poses in (one_scan, Poses.empty(frame="map", georeference=None)):
        files = street_map.report(
            metrics=nothing, error_track=Parts([]), poses=one(poses), tile_index=index, tiles=empty
        )
        text = parse(body(files)).text
        assert "Poor" in text
        assert "The map holds no points" in text
        assert "No truth was given" in text
        assert Image.open(io.BytesIO(street_map.drawn.read("preview.png"))).size[0] >= 16


def test_two_sessions_have_two_colours_and_two_tables(street_map: Map) -> None:
    both = {"a": street_map.T, "b": street_map.T + 0.0}
    sessions: Parts[Session] = Parts([((("session", n),), session_of(n, 5)) for n in both])
    poses: Parts[Poses] = Parts([((("session", n),), poses_of(T)) for n, T in both.items()])
    files = street_map.report(session=sessions, poses=poses)
    page = body(files)
    assert len(plots_of(page)[0]["beads"]) == 2
    assert page.count("<polyline") == 6
    parse(page)


def test_what_the_scans_said_of_the_sensors_is_told_and_escaped(street_map: Map) -> None:
    check = SensorCheck(wheel=WheelCheck(verdict="contradicts"), remarks=("Wheels: <no> known unit.",))
    page = body(street_map.report(check=one(check)))
    assert "Wheels: &lt;no&gt; known unit." in page
    assert '<span class="pill warning">sensors</span>' in page
    assert "sensors</span>" not in body(street_map.report())


def test_cameras_are_listed(street_map: Map) -> None:
    model = CameraModel(
        lens="equidistant",
        width_px=1920,
        height_px=1208,
        fx_px=9,
        fy_px=9,
        cx_px=9,
        cy_px=9,
        distortion=(0, 0, 0, 0),
    )
    seen = Cameras(
        cameras=(Camera(name="cam_front", model=model, source="camera info"),),
        footage=(Footage(camera="cam_front", topic="/cam_front/image_raw", images=1200, kept=240),),
        remarks=("Camera <rear> cannot be used.",),
    )
    page = body(street_map.report(cameras=one(seen)))
    assert "Camera &lt;rear&gt; cannot be used." in page
    assert all(
        text in page for text in ("cam_front", "1920 x 1208", "equidistant", "240", '"pill warning">unknown')
    )
    agreement = CameraAgreement(camera="cam_front", verdict="moved", remark="Camera <front> has turned.")
    page = body(street_map.report(camera_check=one(CameraCheck(cameras=(agreement,)))))
    assert '<span class="pill error">cameras</span> Camera &lt;front&gt; has turned.' in page
    bare = body(street_map.report(cameras=one(Cameras()), camera_check=one(CameraCheck())))
    assert bare == body(street_map.report())


def test_what_the_graph_warns_of_lowers_the_verdict_and_what_it_remarks_does_not(street_map: Map) -> None:
    quiet = replace(Graph.empty(), remarks=("a: the receiver's clock is <0.2 s> late",))
    page = body(street_map.report(graph=quiet))
    assert "clock is &lt;0.2 s&gt; late." in page
    assert '<div class="word">Good</div>' in page
    loud = replace(quiet, warnings=("session a hangs on one loop only",))
    page = body(street_map.report(graph=loud))
    assert "session a hangs on one loop only." in page
    assert '<div class="word">Fair</div>' in page


def test_loops_gnss_and_blind_stretches_have_their_sections(street_map: Map) -> None:
    loops = loops_of(street_map.T, [(0, 4), (1, 4)], [0.0, 0.0])
    loops = replace(loops, accepted=np.array([True, False]), reason=np.array(["", "<unlike>"], object))
    origin = georeference(48.1, 11.6, 520.0).model_dump()
    graph = Graph.concatenate([graph_of(loops), graph_of_fixes(street_map, [0.6, 0.8, 5.0])])
    poses = one(poses_of(street_map.T, georeference=origin))
    index = replace(street_map.index, georeference=origin, frame="world")
    page = body(street_map.report(loops=loops, graph=graph, poses=poses, tile_index=index))
    text = parse(page).text
    for heading in ("Loops", "GNSS along the way", "What odometry could not see", "Pose graph"):
        assert f"<h2>{heading}</h2>" in page
    assert "in use: 1" in text
    assert "compared and refused: 1" in text
    assert "<unlike>" in text
    assert "used: 5" in text
    assert "Every direction was seen" in text
    assert "loop closure" in text


def test_a_map_without_loops_and_gnss_has_no_sections_of_them(street_map: Map) -> None:
    page = body(street_map.report())
    for heading in ("Loops", "GNSS along the way", "Pose graph"):
        assert f"<h2>{heading}</h2>" not in page


def test_a_loop_that_the_graph_left_out_is_not_drawn_on_the_map(street_map: Map) -> None:
    loops = loops_of(street_map.T, [(0, 4)], [0.0])
    street_map.report(loops=loops)
    assert "loop: scan 0 and 4" in street_map.drawn.read("overlay.svg").decode()
    page = body(street_map.report(loops=loops, graph=graph_of(loops, ["switched off"])))
    assert "loop: scan" not in street_map.drawn.read("overlay.svg").decode()
    assert "loop closure" not in page
    assert "passed the tests, left out by the graph: 1" in parse(page).text


def test_what_an_extension_no_longer_found_has_a_section_of_its_own(street_map: Map) -> None:
    gone = changes_of([(10.0, 5.0, 400), (20.0, 5.0, 80)])
    text = parse(body(street_map.report(changes=gone))).text
    assert "2 objects of the map that was extended are no longer there" in text
    assert "480 points that b saw through" in text
    assert "1.0 × 1.0 × 1.0" in text
    assert "31 points that only moving things had left" in text
    assert "is still there" in parse(body(street_map.report(changes=changes_of([])))).text
    assert "What has changed" not in body(street_map.report())
