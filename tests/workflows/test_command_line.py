"""The command line as a whole: help, examples, completion, and JSON from every verb."""

from __future__ import annotations

import json
import os
import shlex
import signal
import subprocess
import sys
import urllib.request
from collections.abc import Callable
from pathlib import Path

import pytest
import typer

from scanloom.workflows.cli import app
from scanloom.workflows.examples import EXAMPLES, complete_formats
from tests.logs import scan_folder
from tests.workflows.test_map import scanloom

GROUP = typer.main.get_command(app)
VERBS = sorted(name for name, verb in GROUP.commands.items() if not verb.hidden)


@pytest.fixture(scope="module")
def place(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with a log, a map of it, and a fleet of it."""
    folder = tmp_path_factory.mktemp("verbs")
    scan_folder(folder / "log")
    (folder / "fleet.yaml").write_text("maps:\n  depot: {sessions: [log]}\n")
    done = scanloom("map", "log", "--out", "map", "--cluster", "none", cwd=folder)
    assert done.returncode == 0, done.stderr
    return folder


def artifact(place: Path) -> str:
    return next(path.parent.name for path in sorted(place.glob("store/tiles/*/manifest.json")))


SPOKEN: dict[str, tuple[Callable[[Path], tuple[str, ...]], Callable[[dict | list], bool]]] = {
    "map": (lambda p: ("log", "--out", "map", "--export", "pcd"), lambda said: said["exports"][0]["format"] == "pcd"),
    "extend": (lambda p: ("map", "other", "--dry-run"), lambda said: any(t["node"] == "fusion" for t in said["tasks"])),
    "sample": (
        lambda p: ("drive", "--set", "simulate.duration_s=10", "--set", "simulate.beams=16", "--set", "simulate.columns=512"),
        lambda said: "metadata.yaml" in said["files"],
    ),
    "inspect": (lambda p: ("log",), lambda said: isinstance(said, dict)),
    "nightly": (lambda p: ("fleet.yaml", "--cluster", "none"), lambda said: said["maps"][0]["map"] == "depot"),
    "compare": (lambda p: ("map", "map"), lambda said: isinstance(said, dict)),
    "export": (lambda p: ("map", "--format", "pcd,tum"), lambda said: [r["format"] for r in said] == ["pcd", "tum"]),
    "explain": (lambda p: (artifact(p),), lambda said: said["stage"] == "tiles"),
    "status": (lambda p: (), lambda said: isinstance(said, dict)),
    "verify": (lambda p: (), lambda said: said["problems"] == []),
    "gc": (lambda p: ("--dry-run",), lambda said: said["bytes"] >= 0),
}  # fmt: skip
"""Of each verb: what it is asked, and whether the answer is about that."""


@pytest.mark.parametrize("verb", [v for v in SPOKEN if v != "extend"])
def test_every_verb_speaks_json(place: Path, verb: str) -> None:
    asked, answers = SPOKEN[verb]
    done = scanloom(verb, *asked(place), "--json", cwd=place)
    assert done.returncode == 0, done.stderr
    assert answers(json.loads(done.stdout))


def test_an_extension_speaks_json(place: Path) -> None:
    scan_folder(place / "other", seed=1)
    asked, answers = SPOKEN["extend"]
    done = scanloom("extend", *asked(place), "--json", cwd=place)
    assert done.returncode == 0, done.stderr
    assert answers(json.loads(done.stdout))


def test_a_map_and_its_exports_in_one_command(place: Path) -> None:
    laspy = pytest.importorskip("laspy")
    done = scanloom("map", "log", "--out", "both", "--export", "laz,3dtiles", "--json", cwd=place)
    assert done.returncode == 0, done.stderr
    said = json.loads(done.stdout)
    points = json.loads((place / "both/map.json").read_text())["points"]
    assert [row["format"] for row in said["exports"]] == ["laz", "3dtiles"] and said["failures"] == []
    assert len(laspy.read(place / "both/exports/laz/map.laz").points) == points
    assert (place / "both/exports/3dtiles/tileset.json").exists()


def test_an_export_that_fails_costs_no_map(place: Path) -> None:
    pytest.importorskip("laspy")
    (place / "one/exports").mkdir(parents=True)
    (place / "one/.scanloom").touch()
    (place / "one/exports/.laz.part").write_text("a file where a folder should be made")
    done = scanloom("map", "log", "--out", "one", "--export", "laz,3dtiles", cwd=place)
    assert done.returncode == 3
    assert "map: one" in done.stderr and "laz: cannot be written" in done.stderr and "Next:" in done.stderr
    assert (place / "one/map.ply").read_bytes() == (place / "map/map.ply").read_bytes()
    assert (place / "one/exports/3dtiles/tileset.json").exists() and not (place / "one/exports/laz").exists()


def test_the_viewer_says_where_it_is_in_json(place: Path) -> None:
    command = [
        sys.executable,
        "-m",
        "scanloom.workflows.cli",
        "view",
        "map",
        "--port",
        "0",
        "--no-browser",
        "--json",
    ]
    process = subprocess.Popen(command, cwd=place, stdout=subprocess.PIPE, text=True)
    try:
        text = ""
        while not text.endswith("}\n"):
            text += process.stdout.readline()
        said = json.loads(text)
        about = json.load(urllib.request.urlopen(f"{said['url']}data/map.json"))
        assert said["map"] == "map" and said["points"] == about["points"] > 100
    finally:
        process.send_signal(signal.SIGINT)
        assert process.wait(20) == 0


def test_no_verb_is_forgotten() -> None:
    assert set(SPOKEN) | {"view", "calibrate"} >= set(VERBS)


@pytest.mark.parametrize("verb", VERBS)
def test_every_verb_has_json_in_its_options(verb: str) -> None:
    assert "--json" in {name for option in GROUP.commands[verb].params for name in option.opts}


@pytest.mark.parametrize("verb", VERBS)
def test_help_has_examples_that_can_be_typed(verb: str) -> None:
    command = GROUP.commands[verb]
    assert command.help and all(getattr(p, "help", "") for p in command.params if p.name != "help")
    assert EXAMPLES[verb] and all(example in (command.epilog or "") for example in EXAMPLES[verb])
    for example in EXAMPLES[verb]:
        program, named, *words = shlex.split(example)
        assert (program, named) == ("scanloom", verb)
        command.make_context(verb, words).close()


@pytest.mark.parametrize("verb", VERBS)
def test_docs_show_every_verb(verb: str) -> None:
    page = (Path(__file__).parents[2] / "docs" / "verbs.md").read_text()
    assert f"\n## {verb}\n" in page
    shown = page.split(f"\n## {verb}\n")[1].split("\n## ")[0]
    typed = [line.removeprefix("$ ") for line in shown.splitlines() if line.startswith(f"$ scanloom {verb}")]
    assert typed, "no example"
    for line in typed:
        GROUP.commands[verb].make_context(verb, shlex.split(line)[2:]).close()


@pytest.mark.parametrize(
    ("words", "code", "said"),
    [
        (("view", "nowhere"), 4, "map.json"),
        (("export", "nowhere", "--format", "pcd"), 4, "map.json"),
        (("export", "map", "--format", "pcdd"), 2, "did you mean pcd"),
        (("compare", "nowhere", "nowhere2"), 4, "nowhere"),
        (("inspect", "nowhere"), 4, "nowhere"),
    ],
)
def test_errors_are_json_too(place: Path, words: tuple[str, ...], code: int, said: str) -> None:
    done = scanloom(*words, "--json", cwd=place)
    body = json.loads(done.stdout)
    assert done.returncode == body["exit_code"] == code
    assert said in json.dumps(body["error"]) and body["error"]["next_step"]
    assert said in done.stderr


def completed(*words: str) -> list[str]:
    """What bash would offer for the last of some words."""
    line = " ".join(("scanloom", *words))
    run = subprocess.run(
        [sys.executable, "-c", "import sys; sys.argv = ['scanloom']; from scanloom.workflows.cli import main; main()"],
        env=os.environ | {"_SCANLOOM_COMPLETE": "complete_bash", "COMP_WORDS": line, "COMP_CWORD": str(len(words))},
        capture_output=True, text=True, timeout=60,
    )  # fmt: skip
    return run.stdout.split()


def test_the_shell_completes() -> None:
    assert {"export", "extend", "explain"} <= set(completed("ex"))
    assert "warm" not in completed("")
    assert "--format" in completed("export", "--for")
    assert completed("export", "maps/a", "--heights", "ortho") == ["orthometric"]
    assert set(completed("export", "maps/a", "--format", "laz,ge")) == {"laz,geojson", "laz,geoparquet"}


def test_formats_are_completed_once_each() -> None:
    assert complete_formats("co") == ["copc"]
    assert "laz,laz" not in complete_formats("laz,") and "laz,copc" in complete_formats("laz,")
    assert complete_formats("laz,zzz") == []


def test_how_to_install_completion_is_in_the_help(tmp_path: Path) -> None:
    said = scanloom("--help", cwd=tmp_path).stdout
    assert "--install-completion" in said and "--show-completion" in said
