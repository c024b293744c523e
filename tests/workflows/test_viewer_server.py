"""The server of the viewer: every node is served, nothing else is, and only to this machine."""

from __future__ import annotations

import http.client
import json
import shutil
import socket
import struct
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from scanloom.schemas.errors import InvalidInput, UsageError
from scanloom.schemas.scans import PointClass
from scanloom.stages.geometry.geodesy import projected_to_world
from scanloom.workflows.view_map import view_map
from scanloom.workflows.viewer.server import LOOPBACK, Server
from tests.viewed import (
    FIRST_NS,
    INTENSITIES,
    ORIGIN,
    POINTS,
    Running,
    make_map,
    paint,
    points_of,
    removed_places,
    scene,
)


@pytest.fixture(scope="module")
def served(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Server]:
    folder = tmp_path_factory.mktemp("viewer") / "m"
    make_map(folder, removed=120_000)
    with Running(folder) as server:
        yield server


def ask(server: Server, path: str, *, method: str = "GET", host: str | None = None, **headers: str):
    line = http.client.HTTPConnection(LOOPBACK, server.server_port, timeout=20)
    line.putrequest(method, path, skip_host=True)
    line.putheader("Host", f"{LOOPBACK}:{server.server_port}" if host is None else host)
    for name, value in headers.items():
        line.putheader(name.replace("_", "-"), value)
    line.endheaders()
    answer = line.getresponse()
    body = answer.read()
    line.close()
    return answer, body


def json_of(server: Server, path: str):
    answer, body = ask(server, path)
    assert answer.status == 200, (path, body)
    assert answer.getheader("Content-Type") == "application/json"
    return json.loads(body)


def contents(server: Server, path: str) -> Iterator[str]:
    """Paths of all contents of a tileset, tilesets within opened."""
    folder = path.rpartition("/")[0]
    tiles = [json_of(server, path)["root"]]
    while tiles:
        tile = tiles.pop()
        tiles += tile.get("children", [])
        uri = f"{folder}/{tile['content']['uri']}" if "content" in tile else ""
        if uri.endswith(".json"):
            yield from contents(server, uri)
        elif uri:
            yield uri


def test_all_contents_together_are_the_map(served: Server) -> None:
    paths = list(contents(served, "/data/tileset/tileset.json"))
    assert len(paths) == len(set(paths)) > 20
    got = [points_of(ask(served, path)[1]) for path in paths]
    numbers = np.concatenate([v["intensity"] for v, _ in got])
    places = np.concatenate([p for _, p in got])
    truth = scene()
    rows = np.searchsorted(INTENSITIES, numbers)
    assert np.array_equal(np.sort(rows), np.arange(POINTS))
    assert np.abs(places - truth[rows]).max() < 1e-4
    assert json_of(served, "/data/map.json")["points"] == POINTS


def test_removed_points_are_served_whole_when_they_are_few(served: Server) -> None:
    paths = list(contents(served, "/data/removed/tileset.json"))
    vertices = [points_of(ask(served, path)[1])[0] for path in paths]
    assert len(vertices[0]) == pytest.approx(40_000, abs=2)  # every third
    assert sum(map(len, vertices)) == 120_000
    assert {int(c) for v in vertices for c in v["class"][:, 0]} == {PointClass.DYNAMIC}


def test_the_map_is_described(served: Server) -> None:
    about = json_of(served, "/data/map.json")
    assert (about["name"], about["epsg"], about["crs"]) == ("Old town", 32632, "WGS 84 / UTM zone 32N")
    assert about["classes"] == {"1": "ground", "2": "static"}
    assert about["sessions"] == ["drive"]
    assert about["removed"] == {"points": 120_000, "classes": {"3": "dynamic"}}
    assert about["height_m"][0] < 0.1 and 4.0 < about["height_m"][1] <= 8.0


def test_a_point_is_told_in_the_maps_own_system(served: Server) -> None:
    path = next(p for p in contents(served, "/data/tileset/tileset.json") if p.count("_") >= 4)
    vertices, places = points_of(ask(served, path)[1])
    row = len(vertices) // 2
    about = json_of(served, path.replace("/data/tileset/", "/data/point/").removesuffix(".glb") + f"/{row}")
    assert np.allclose(about["map_m"], places[row], atol=1e-4)
    projected = [about["easting_m"], about["northing_m"], about["height_m"]]
    assert np.allclose(projected_to_world(ORIGIN, projected)[0], places[row], atol=1e-3)
    assert about["epsg"] == 32632
    assert 48.19 < about["latitude_deg"] < 48.21 and 11.59 < about["longitude_deg"] < 11.61
    assert about["session"] == "drive"
    assert about["intensity"] == pytest.approx(float(vertices["intensity"][row]))
    number = int(np.searchsorted(INTENSITIES, vertices["intensity"][row]))
    assert about["first_ns"] == str(1_760_000_000_000_000_000 + number)


@pytest.mark.parametrize("kind", ["root.glb", "blocks/"])
def test_a_removed_point_tells_why_it_was_left_out(served: Server, kind: str) -> None:
    path = next(p for p in contents(served, "/data/removed/tileset.json") if kind in p)
    vertices, places = points_of(ask(served, path)[1])
    row = len(vertices) // 3
    node = path.removeprefix("/data/removed/").removesuffix(".glb")
    about = json_of(served, f"/data/removed/point/{node}/{row}")
    assert np.allclose(about["map_m"], places[row], atol=1e-4)
    assert about["class"] == "dynamic" and "moved" in about["why"]
    number = int(about["first_ns"]) - FIRST_NS
    assert np.allclose(removed_places(120_000)[number], about["map_m"], atol=0.02)
    assert about["session"] == "drive"
    projected = [about["easting_m"], about["northing_m"], about["height_m"]]
    assert np.allclose(projected_to_world(ORIGIN, projected)[0], places[row], atol=1e-3)


def test_a_removed_point_without_its_tile_is_told_by_its_class(tmp_path: Path) -> None:
    make_map(tmp_path / "m", removed=50)
    shutil.rmtree(tmp_path / "m" / "removed")
    with Running(tmp_path / "m") as server:
        about = json_of(server, "/data/removed/point/root/49")
        assert about["class"] == "dynamic" and "first_ns" not in about
        assert ask(server, "/data/removed/point/root/50")[0].status == 404


def test_colour_is_there_when_tiles_have_it(served: Server, tmp_path: Path) -> None:
    assert json_of(served, "/data/map.json")["coloured"] is False
    make_map(tmp_path / "m")
    paint(tmp_path / "m")
    with Running(tmp_path / "m") as server:
        assert json_of(server, "/data/map.json")["coloured"] is True
        path = next(p for p in contents(server, "/data/tileset/tileset.json") if "0_0/" in p)
        vertices, places = points_of(ask(server, path)[1])
        assert len(vertices) and (vertices["colour"][:, 2] == 255).all() and (places[:, 0] > 0).all()
        assert np.abs(vertices["colour"][:, 0] - np.clip(places[:, 0] * 8.0, 1, 255)).max() <= 1.01
        west = next(p for p in contents(server, "/data/tileset/tileset.json") if "-1_0/" in p)
        grey, _ = points_of(ask(server, west)[1])
        assert (grey["colour"][:, :3].astype(int).sum(axis=1) > 100).all()
        node = path.removeprefix("/data/tileset/").removesuffix(".glb")
        assert json_of(server, f"/data/point/{node}/0")["colour"] == vertices["colour"][0, :3].tolist()


@pytest.mark.parametrize(
    "path",
    [
        "/data/removed/point/root/-1", "/data/removed/point/root/x", "/data/removed/point/nothing/0", "/data/removed/point/",
        "/data/", "/data/nothing", "/data/tileset/", "/data/tileset/nothing.glb", "/data/tileset/tiles/9_9.json",
        "/data/tileset/tiles/0_0/0_99_0_0.glb", "/data/tileset/tiles/0_0.glb", "/data/tileset/../map.json",
        "/data/point/root/-1", "/data/point/root/99999999", "/data/point/root/x", "/data/point/nothing/0",
        "/data/removed/nothing.glb", "/data/removed/blocks/x.glb", "/etc/passwd", "/../map.json", "/..%2f..%2fmap.json",
        "/%2e%2e/%2e%2e/etc/passwd", "/data/tileset/tiles/..%2f..%2fmap.json", "//etc/passwd", "/answers.py", "/vendor/package.json",
    ],
)  # fmt: skip
def test_what_is_not_there_is_not_found(served: Server, path: str) -> None:
    answer, body = ask(served, path)
    assert (answer.status, body) == (404, b"nothing here")


@pytest.mark.parametrize("host", ["evil.example", "127.0.0.1", "", "127.0.0.1.evil.example:80", "[::1]:80"])
def test_a_foreign_host_name_is_refused(served: Server, host: str) -> None:
    answer, body = ask(served, "/data/map.json", host=host)
    assert answer.status == 421 and b"points" not in body


def test_localhost_is_this_machine_too(served: Server) -> None:
    assert ask(served, "/", host=f"localhost:{served.server_port}")[0].status == 200
    assert ask(served, "/", host=f"localhost:{served.server_port + 1}")[0].status == 421


def test_other_sites_get_nothing(served: Server) -> None:
    assert ask(served, "/data/map.json", Sec_Fetch_Site="cross-site")[0].status == 403
    assert ask(served, "/data/map.json", Sec_Fetch_Site="same-origin")[0].status == 200
    answer, _ = ask(served, "/data/map.json", Origin="http://evil.example")
    assert answer.getheader("Access-Control-Allow-Origin") is None


@pytest.mark.parametrize("method", ["POST", "PUT", "DELETE", "OPTIONS", "PATCH"])
def test_nothing_can_be_written(served: Server, method: str) -> None:
    assert ask(served, "/data/map.json", method=method)[0].status == 501


def test_head_has_no_body(served: Server) -> None:
    answer, body = ask(served, "/data/map.json", method="HEAD")
    assert answer.status == 200 and body == b"" and int(answer.getheader("Content-Length") or 0) > 100


def test_only_this_machine_is_listened_to(served: Server) -> None:
    assert served.server_address[0] == "127.0.0.1"


def test_the_page_may_load_nothing_from_elsewhere(served: Server) -> None:
    answer, body = ask(served, "/")
    policy = answer.getheader("Content-Security-Policy") or ""
    assert "default-src 'none'" in policy and "http" not in policy and "*" not in policy
    page = body.decode()
    assert "http://" not in page and "https://" not in page
    for name in ("app.js", "style.css", "vendor.js", "cloud.js"):
        answer, body = ask(served, f"/{name}")
        assert answer.status == 200 and len(body) > 500
        assert answer.getheader("X-Content-Type-Options") == "nosniff"


def test_a_taken_port_is_named(served: Server, tmp_path: Path) -> None:
    make_map(tmp_path / "m")
    with pytest.raises(UsageError, match=f"port {served.server_port}"):
        view_map(tmp_path / "m", served.server_port, False, lambda _: None)


def test_a_folder_without_a_map_is_named(tmp_path: Path) -> None:
    with pytest.raises(InvalidInput, match="no map"):
        view_map(tmp_path, 0, False, lambda _: None)


def test_lines_stand_where_they_were_driven(served: Server) -> None:
    layers = json_of(served, "/data/layers.json")
    (track,) = layers["trajectories"]
    assert track["session"] == "drive" and len(track["points"]) == 40
    assert track["points"][0] == [-25.0, 0.0, 1.7] and track["points"][-1] == [25.0, 0.0, 1.7]
    (loop,) = layers["loops"]
    assert (loop["from"], loop["to"]) == (track["points"][2], track["points"][30])
    (car,) = layers["objects"]
    assert car["class"] == "vehicle" and len(car["path"]) == 9 and len(car["boxes"]) == 4
    first = np.add(track["points"][5], (10.0, 0.0, -1.7))
    assert np.allclose(car["path"][0], first, atol=2e-3)
    assert np.allclose(np.reshape(car["boxes"][0]["matrix"], (4, 4))[3, :3], first, atol=2e-3)
    assert car["boxes"][0]["size_m"] == [4.2, 1.8, 1.5]


def test_a_damaged_tile_is_named_and_the_rest_is_served(tmp_path: Path) -> None:
    make_map(tmp_path / "m")
    (tmp_path / "m" / "tiles" / "0_0.parquet").write_bytes(b"PAR1 and then nothing")
    with Running(tmp_path / "m") as server:
        answer, body = ask(server, "/data/tileset/tiles/0_0.json")
        assert answer.status == 500 and b"0_0.parquet" in body
        assert ask(server, "/data/tileset/tiles/0_-1.json")[0].status == 200
        assert ask(server, "/data/tileset/root.glb")[0].status == 200


def test_a_browser_that_hangs_up_is_no_error(served: Server, caplog: pytest.LogCaptureFixture) -> None:
    for _ in range(5):
        with socket.create_connection((LOOPBACK, served.server_port)) as line:
            line.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))
            line.sendall(f"GET /vendor.js HTTP/1.1\r\nHost: {LOOPBACK}:{served.server_port}\r\n\r\n".encode())
    assert ask(served, "/")[0].status == 200
    assert [record for record in caplog.records if record.levelname == "ERROR"] == []
