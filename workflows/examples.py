"""What is typed: examples at the foot of each verb's help. `docs/verbs.md` shows what they print."""

from __future__ import annotations

from collections.abc import Mapping

EXAMPLES: Mapping[str, tuple[str, ...]] = {
    "map": (
        "scanloom map drive.mcap",
        "scanloom map monday.mcap tuesday.mcap --out maps/town --export laz,dem",
        "scanloom map sample --set tiling.tile_size_m=100 --dry-run",
    ),
    "extend": ("scanloom extend maps/town wednesday.mcap", "scanloom extend maps/sample sample2 --mode soft"),
    "sample": ("scanloom sample drive --set simulate.duration_s=60",),
    "inspect": ("scanloom inspect drive.mcap", "scanloom inspect session.yaml --json"),
    "calibrate": (
        "scanloom calibrate boards.mcap --board board.yaml --out calibration",
        "scanloom calibrate rig --out calibration",
    ),
    "nightly": ("scanloom nightly fleet.yaml --out /maps",),
    "compare": (
        "scanloom compare maps/before maps/after --report comparison.html",
        "scanloom compare --measure-noise noise.json run1 run2 run3 run4 run5",
    ),
    "export": (
        "scanloom export maps/town --format copc,dem,geojson",
        "scanloom export maps/town --format laz --epsg 25832 --out /gis",
        "scanloom export --list",
    ),
    "view": ("scanloom view maps/town", "scanloom view maps/town --port 0 --no-browser --json"),
    "explain": ("scanloom explain 3fa9c1", "scanloom explain store/tiles/3fa9c1"),
    "status": ("scanloom status", "scanloom status --json"),
    "verify": ("scanloom verify --store /data/store",),
    "gc": ("scanloom gc --keep-runs 2 --dry-run",),
}


def epilog(verb: str) -> str | None:
    """Foot of the help of a verb."""
    shown = EXAMPLES.get(verb, ())
    return "\n\n".join([f"Example{'s' * (len(shown) > 1)}:", *shown]) if shown else None


def complete_formats(incomplete: str) -> list[str]:
    """What the last of some formats, separated by commas, may become."""
    from scanloom.stages.exports.formats import FORMATS

    before, comma, last = incomplete.rpartition(",")
    given = before.split(",")
    return [before + comma + name for name in FORMATS if name.startswith(last) and name not in given]
