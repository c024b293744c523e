"""The command line: the only module that prints or exits."""

from __future__ import annotations

import json
import logging
import os
import sys
import time
from enum import StrEnum
from gc import set_threshold
from pathlib import Path
from typing import Annotated, Any

import typer

from scanloom.schemas.errors import EXIT_INTERNAL, EXIT_INTERRUPTED, EXIT_OK, ScanloomError, UsageError
from scanloom.workflows.examples import complete_formats, epilog

app = typer.Typer(
    name="scanloom",
    help="Weaves vehicle and robot logs into georeferenced, cleaned, tiled 3D maps.",
    no_args_is_help=True,
    pretty_exceptions_enable=False,
)

StoreOption = Annotated[
    Path | None,
    typer.Option("--store", help="Folder of the artifact store (default $SCANLOOM_STORE or ./store)."),
]
JsonOption = Annotated[bool, typer.Option("--json", help="Machine-readable result on stdout.")]
SetOption = Annotated[
    list[str] | None, typer.Option("--set", help="A setting, stage.field=value; may be repeated.")
]
ClusterOption = Annotated[
    str, typer.Option("--cluster", help="local, none, tcp://host:port or module:factory.")
]
WorkersOption = Annotated[
    int | None, typer.Option("--workers", min=1, help="Local processes (default: one per core).")
]
ExportOption = Annotated[
    str,
    typer.Option(
        "--export",
        help="Formats to export the map to as well, separated by commas, as laz,copc.",
        autocompletion=complete_formats,
    ),
]
ProjectOption = Annotated[
    Path | None, typer.Option("--project", help="Settings file (default ./scanloom.yaml when present).")
]


class Mode(StrEnum):
    """What an extension does to the poses of the map."""

    RIGID = "rigid"
    SOFT = "soft"


class Method(StrEnum):
    """How cameras are calibrated."""

    BOARD = "board"
    PAPER = "paper"


class Heights(StrEnum):
    """What the heights of an export are counted from."""

    ELLIPSOIDAL = "ellipsoidal"
    ORTHOMETRIC = "orthometric"


OBJECTS_BETWEEN_COLLECTIONS = 100_000
"""Imports make many objects that stay; looking for garbage among them every 700 objects took a quarter of their time."""


def main() -> None:
    """Entry point: errors become one clear sentence and an exit code."""
    set_threshold(OBJECTS_BETWEEN_COLLECTIONS)
    logging.basicConfig(stream=sys.stderr, level=logging.WARNING, format="%(message)s")
    logging.getLogger("scanloom").setLevel(logging.INFO)
    try:
        code = app(standalone_mode=False)
        sys.exit(code if isinstance(code, int) else EXIT_OK)
    except ScanloomError as error:
        if "--json" in sys.argv:
            _emit(_as_json(error))
        _fail(str(error), error.exit_code)
    except KeyboardInterrupt:
        _fail("interrupted; the same command continues where it stopped", EXIT_INTERRUPTED)
    except Exception as error:
        _unexpected(error)


def _unexpected(error: Exception) -> None:
    usage = getattr(error, "exit_code", None)
    if usage is not None and hasattr(error, "format_message"):
        error.show()  # type: ignore[attr-defined]
        sys.exit(usage)
    if os.environ.get("SCANLOOM_DEBUG"):
        raise error
    _fail(
        f"internal error: {type(error).__name__}: {error}. Next: run again with SCANLOOM_DEBUG=1 to see where, and report it",
        EXIT_INTERNAL,
    )


def _fail(message: str, code: int) -> None:
    print(f"scanloom: {message}", file=sys.stderr)
    sys.exit(code)


def _as_json(error: ScanloomError) -> dict[str, Any]:
    told = {"what": error.what, "where": error.where, "next_step": error.next_step}
    return {"error": told, "exit_code": error.exit_code}


def _say(message: str) -> None:
    print(message, file=sys.stderr)


def _emit(body: Any) -> None:
    print(json.dumps(body, indent=1, default=str), flush=True)


def _process_start_s() -> float:
    """When this command was started, seconds since 1970."""
    import psutil

    return float(psutil.Process().create_time())


def _store_folder(given: Path | None) -> Path:
    return given or Path(os.environ.get("SCANLOOM_STORE", "store"))


def _start_workers(cluster: str, *, idle: bool = False) -> None:
    """Workers import on another core what this process imports next."""
    if cluster == "local" and not idle:
        from scanloom.pipeline.forkserver import start_forkserver

        start_forkserver(["scanloom.workflows.warm_workers"])


@app.command("map")
def map_command(
    sessions: Annotated[
        list[str], typer.Argument(help="Logs: bag, folder, .mcap, KITTI folder, session.yaml, or `sample`.")
    ],
    out: Annotated[Path | None, typer.Option("--out", help="Folder of the map (default maps/NAME).")] = None,
    store: StoreOption = None,
    cluster: ClusterOption = "local",
    workers: WorkersOption = None,
    settings: SetOption = None,
    project: ProjectOption = None,
    export_to: ExportOption = "",
    dry_run: Annotated[
        bool, typer.Option("--dry-run", help="Say what would run and why; compute nothing.")
    ] = False,
    as_json: JsonOption = False,
) -> None:
    """Logs into a map: trajectory, tiles, metrics and a report."""
    _start_workers(cluster, idle=dry_run)
    _check_formats(export_to)
    from scanloom.pipeline.progress import progress_for
    from scanloom.workflows.build_map import Order, build_map, plan_map
    from scanloom.workflows.configuration import command_line_settings, project_settings
    from scanloom.workflows.sessions import map_name

    name = out.name if out else map_name(sessions)
    order = Order(
        sessions=tuple(sessions),
        out=out or Path("maps") / name,
        name=name,
        store=_store_folder(store),
        cluster=cluster,
        workers=workers,
        project=project_settings(project),
        command_line=command_line_settings(settings or []),
        started_s=_process_start_s(),
    )
    if dry_run:
        _show_plan(*plan_map(order), as_json)
        return
    outcome = build_map(order, progress_for(sys.stderr))
    outcome, exported = _export_after(outcome, export_to)
    _show_outcome(outcome, exported, as_json)
    raise typer.Exit(outcome.exit_code)


@app.command()
def extend(
    folder: Annotated[
        Path, typer.Argument(metavar="MAP", help="Folder of a finished map; it stays as it is.")
    ],
    sessions: Annotated[
        list[str], typer.Argument(help="Logs to add, as for `map`; `sample2` fits `sample`.")
    ],
    out: Annotated[
        Path | None, typer.Option("--out", help="Folder of the new version (default MAP-v2 beside it).")
    ] = None,
    mode: Annotated[
        Mode, typer.Option("--mode", help="rigid: old poses stay; soft: they give way to new loops.")
    ] = Mode.RIGID,
    log: Annotated[
        list[str] | None, typer.Option("--log", help="NAME=PATH: where the log of an old session lies now.")
    ] = None,
    store: StoreOption = None,
    cluster: ClusterOption = "local",
    workers: WorkersOption = None,
    settings: SetOption = None,
    project: ProjectOption = None,
    export_to: ExportOption = "",
    dry_run: Annotated[
        bool, typer.Option("--dry-run", help="Say what would run and why; compute nothing.")
    ] = False,
    as_json: JsonOption = False,
) -> None:
    """Add sessions to a finished map: a new version beside it, with what has changed since."""
    _start_workers(cluster, idle=dry_run)
    _check_formats(export_to)
    from scanloom.pipeline.progress import progress_for
    from scanloom.workflows.build_map import build_map, plan_map
    from scanloom.workflows.configuration import command_line_settings, project_settings
    from scanloom.workflows.extend_map import extension_order, moved_logs
    from scanloom.workflows.parent import read_parent

    told = store or os.environ.get("SCANLOOM_STORE")
    order = extension_order(
        read_parent(folder, moved_logs(log or [])),
        sessions,
        out=out,
        store=Path(told) if told else None,
        mode=mode.value,
        project=project_settings(project) if project else {},
        command_line=command_line_settings(settings or []),
        cluster=cluster,
        workers=workers,
        started_s=_process_start_s(),
    )
    if dry_run:
        _show_plan(*plan_map(order), as_json)
        return
    outcome = build_map(order, progress_for(sys.stderr))
    outcome, exported = _export_after(outcome, export_to)
    _show_outcome(outcome, exported, as_json)
    raise typer.Exit(outcome.exit_code)


def _show_plan(tasks: list[Any], errors: list[tuple[str, ScanloomError]], as_json: bool) -> None:
    if as_json:
        shown = ("node", "coordinate", "verdict", "reason", "key")
        rows = [{name: getattr(task, name) for name in shown} for task in tasks]
        _emit({"tasks": rows, "failures": [str(error) for _, error in errors]})
    else:
        for task in tasks:
            place = "/".join(task.coordinate.values())
            print(f"{task.verdict:5} {task.node:11} {place:24} {task.key[:12]:12} {task.reason}")
        for _, error in errors:
            _say(f"scanloom: {error}")
    if errors and not tasks:
        raise typer.Exit(errors[0][1].exit_code)


def _check_formats(names: str) -> None:
    """Before hours of mapping, whether what is to follow can be done."""
    if names:
        from scanloom.workflows.export_map import formats_of

        formats_of(names)


def _export_after(outcome: Any, names: str) -> tuple[Any, list[Any]]:
    """The outcome with what failed to be exported, and what was exported. The map is there in any case."""
    if not names or not outcome.delivered:
        return outcome, []
    from scanloom.pipeline.progress import progress_for
    from scanloom.workflows.export_after import export_after

    return export_after(outcome, names, progress_for(sys.stderr))


def _show_outcome(outcome: Any, exported: list[Any], as_json: bool) -> None:
    for text in outcome.warnings:
        _say(f"warning: {text}")
    for _, error in outcome.failures:
        _say(f"scanloom: {error}")
    if as_json:
        _emit(
            {
                "out": str(outcome.out) if outcome.delivered else None,
                "exit_code": outcome.exit_code,
                "executed": outcome.executed,
                "metrics": outcome.metrics,
                "warnings": outcome.warnings,
                "exports": [entry.as_json() for entry in exported],
                "failures": [{"where": place, "error": str(error)} for place, error in outcome.failures],
            }
        )
    elif outcome.delivered:
        _say(f"map: {outcome.out}   report: {outcome.out / 'report.html'}")
        for row in outcome.metrics:
            if row["name"] in HEADLINE:
                print(f"{row['name']:36} {row['value']:12.4g} {row['unit']}")
    if not as_json:
        for entry in exported:
            print(entry.text())


HEADLINE = {
    "odometry.kitti_t_rel_percent",
    "odometry.path_length_m",
    "fusion.ate_rmse_m",
    "loops.accepted",
    "loops.precision",
    "map.points",
    "map.mme_r0.5_nat",
    "run.wall_s",
    "run.realtime_factor",
    "run.peak_rss_mb",
}


@app.command()
def sample(
    folder: Annotated[Path, typer.Argument(help="Where the log and the truth beside it are written.")],
    settings: SetOption = None,
    store: StoreOption = None,
    as_json: JsonOption = False,
) -> None:
    """Write the embedded sample session: a rosbag2 MCAP log from the simulator, with truth beside it."""
    from scanloom.workflows.configuration import command_line_settings
    from scanloom.workflows.sample import write_sample

    files = write_sample(folder, _store_folder(store), command_line_settings(settings or []))
    if as_json:
        _emit({"folder": str(folder), "files": files})
    else:
        print(f"{folder}: {', '.join(files)}")


@app.command()
def inspect(
    session: Annotated[str, typer.Argument(help="A log, as for `map`.")],
    settings: SetOption = None,
    as_json: JsonOption = False,
) -> None:
    """What is in a log, what would be used, what is wrong with it; computes nothing."""
    from scanloom.workflows.configuration import command_line_settings
    from scanloom.workflows.inspection import exit_code_of, inspection_of, text_of

    found = inspection_of(session, command_line_settings(settings or []))
    if as_json:
        _emit(found.as_json())
    else:
        print(text_of(found))
    raise typer.Exit(exit_code_of(found))


@app.command("calibrate")
def calibrate_command(
    session: Annotated[
        Path,
        typer.Argument(
            help="A log in which a board stands still in several places, or a folder with clouds/, images/, camera_info.yaml (or "
            "camera_info/) and board.yaml."
        ),
    ],
    out: Annotated[Path, typer.Option("--out", help="Folder of the calibration and its pictures.")],
    board: Annotated[
        Path | None, typer.Option("--board", help="The board's file (default board.yaml of the session).")
    ] = None,
    method: Annotated[
        Method | None,
        typer.Option("--method", help="board: a pose per board; paper: free corner points, for comparison."),
    ] = None,
    settings: SetOption = None,
    pictures: Annotated[bool, typer.Option(help="Draw a picture per placement.")] = True,
    as_json: JsonOption = False,
) -> None:
    """Cameras to a LiDAR from a chessboard shown in a few places."""
    from scanloom.workflows.calibrate_rig import calibrate_rig, order_of, text_of
    from scanloom.workflows.configuration import command_line_settings

    overrides = command_line_settings(settings or [])
    if method is not None:
        overrides.setdefault("calibrate", {})["method"] = method.value
    outcome = calibrate_rig(order_of(session, out, board, overrides, pictures))
    if as_json:
        _emit(outcome.as_json())
    else:
        print(text_of(outcome))


@app.command()
def nightly(
    fleet: Annotated[Path, typer.Argument(help="FLEET.yaml: maps, each with sessions by path or glob.")],
    out: Annotated[
        Path | None, typer.Option("--out", help="Folder of the maps and the summary (default: the file's).")
    ] = None,
    store: StoreOption = None,
    cluster: ClusterOption = "local",
    workers: WorkersOption = None,
    as_json: JsonOption = False,
) -> None:
    """Many logs, many maps, one summary; a bad log never stops the night."""
    _start_workers(cluster)
    from scanloom.pipeline.progress import progress_for
    from scanloom.workflows.nightly import run_fleet

    night = run_fleet(
        fleet, out, _store_folder(store), cluster=cluster, workers=workers, progress=progress_for(sys.stderr)
    )
    for row in night.failures + night.regressions:
        _say(f"scanloom: {row}")
    if as_json:
        _emit(night.summary)
    else:
        print(f"summary: {night.page}")
    raise typer.Exit(night.exit_code)


@app.command()
def compare(
    maps: Annotated[
        list[Path], typer.Argument(metavar="MAP_A MAP_B", help="Two finished maps; B is judged.")
    ],
    noise: Annotated[
        list[Path] | None,
        typer.Option("--noise", help="A file of noise, or three or more maps of the same log (repeated)."),
    ] = None,
    measure_noise: Annotated[
        Path | None,
        typer.Option(
            "--measure-noise", help="Write the noise of all maps given, at least three, to this file."
        ),
    ] = None,
    report: Annotated[
        Path | None, typer.Option("--report", help="Write the comparison as a page to this file, too.")
    ] = None,
    as_json: JsonOption = False,
) -> None:
    """Two maps side by side; exit code 5 when the second is worse by more than noise."""
    from scanloom.schemas.errors import UsageError
    from scanloom.workflows.compare_maps import compare_maps, noise_of
    from scanloom.workflows.comparison_text import text_of_comparison, text_of_noise
    from scanloom.workflows.delivery import write_text

    if measure_noise is not None:
        found_noise = noise_of(maps)
        found_noise.write(measure_noise)
        _emit(found_noise.as_json()) if as_json else print(text_of_noise(found_noise))
        return
    if len(maps) != 2:
        raise UsageError(
            f"{len(maps)} maps were given, not two", next_step="say scanloom compare MAP_A MAP_B"
        )
    found = compare_maps(maps[0], maps[1], noise or [])
    if report is not None:
        write_text(report, found.page())
    _emit(found.as_json()) if as_json else print(text_of_comparison(found))
    raise typer.Exit(found.exit_code)


@app.command()
def export(
    folder: Annotated[
        Path | None, typer.Argument(metavar="MAP", help="Folder of a finished map.", show_default=False)
    ] = None,
    formats: Annotated[
        str,
        typer.Option(
            "--format",
            help="Formats, separated by commas; `scanloom export --list` names them.",
            autocompletion=complete_formats,
        ),
    ] = "",
    out: Annotated[
        Path | None, typer.Option("--out", help="Folder of the exports (default MAP/exports).")
    ] = None,
    epsg: Annotated[
        int | None,
        typer.Option("--epsg", help="EPSG code of a projected system (default the map's UTM zone)."),
    ] = None,
    heights: Annotated[
        Heights, typer.Option("--heights", help="Above the ellipsoid, or above the geoid of --vertical-epsg.")
    ] = Heights.ELLIPSOIDAL,
    vertical_epsg: Annotated[
        int | None,
        typer.Option("--vertical-epsg", help="System of orthometric heights (default 5773, EGM96)."),
    ] = None,
    removed: Annotated[
        bool,
        typer.Option("--removed", help="With the points that are left out of the map, by their classes."),
    ] = False,
    per_tile: Annotated[
        bool, typer.Option("--per-tile", help="LAZ: one file per tile besides the whole map.")
    ] = False,
    cell_m: Annotated[
        float | None, typer.Option("--cell-m", help="Rasters: edge of a cell, m (default 0.25).")
    ] = None,
    fill_cells: Annotated[
        int | None,
        typer.Option("--fill-cells", help="Ground heights: cells to interpolate into holes (default 4)."),
    ] = None,
    list_all: Annotated[bool, typer.Option("--list", help="Only say which formats there are.")] = False,
    as_json: JsonOption = False,
) -> None:
    """A map into other formats: point clouds with their coordinate system, trajectories, rasters, web tiles."""
    from scanloom.pipeline.progress import progress_for
    from scanloom.workflows.export_map import export_all, known_formats, options_of

    if list_all:
        rows = known_formats()
        _emit(rows) if as_json else print("\n".join(f"{row['format']:11} {row['doc']}" for row in rows))
        return
    if folder is None:
        raise UsageError("no map is named", next_step="scanloom export MAP --format laz,copc")
    options = options_of(
        epsg=epsg,
        heights=heights.value,
        vertical_epsg=vertical_epsg,
        removed=removed,
        per_tile=per_tile,
        cell_m=cell_m,
        fill_cells=fill_cells,
    )
    done, failures = export_all(folder, formats, options, out, progress_for(sys.stderr))
    if as_json:
        failed = [{"format": name, "error": str(error)} for name, error in failures]
        _emit([entry.as_json() for entry in done] + failed)
    else:
        for entry in done:
            print(entry.text())
    for name, error in failures:
        _say(f"scanloom: {name}: {error}")
    raise typer.Exit(failures[0][1].exit_code if failures else EXIT_OK)


@app.command()
def view(
    folder: Annotated[Path, typer.Argument(metavar="MAP", help="Folder of a finished map.")],
    port: Annotated[
        int, typer.Option("--port", min=0, max=65535, help="Of 127.0.0.1; 0 takes any that is free.")
    ] = 8642,
    browser: Annotated[bool, typer.Option(help="Open the page in the browser.")] = True,
    as_json: JsonOption = False,
) -> None:
    """A map in the browser: served on this machine alone, streamed by level of detail; ends with Ctrl-C."""
    from scanloom.workflows.view_map import view_map

    view_map(folder, port, browser, _say, _emit if as_json else None)


@app.command()
def explain(
    artifact: Annotated[str, typer.Argument(help="Key of an artifact (a prefix will do), or its folder.")],
    store: StoreOption = None,
    as_json: JsonOption = False,
) -> None:
    """Why an artifact is what it is: stage, settings, code version, inputs."""
    from scanloom.workflows.housekeeping import explanation, text_of_explanation

    found = explanation(_store_folder(store), artifact)
    if as_json:
        _emit(found)
    else:
        print(text_of_explanation(found))


@app.command()
def status(store: StoreOption = None, as_json: JsonOption = False) -> None:
    """What the store holds, and how the last runs ended."""
    from scanloom.workflows.housekeeping import store_status, text_of_status

    found = store_status(_store_folder(store))
    if as_json:
        _emit(found)
    else:
        print(text_of_status(found))


@app.command()
def verify(store: StoreOption = None, as_json: JsonOption = False) -> None:
    """Read every artifact again and compare checksums; damaged ones are set aside and made anew by the next run."""
    from scanloom.workflows.housekeeping import verify_store

    found = verify_store(_store_folder(store))
    if as_json:
        _emit(found)
    else:
        for problem in found["problems"]:
            print(problem)
        print(f"{found['checked']} artifacts checked, {len(found['problems'])} damaged")
    raise typer.Exit(EXIT_INTERNAL if found["problems"] else EXIT_OK)


@app.command()
def gc(
    store: StoreOption = None,
    keep_runs: Annotated[int, typer.Option("--keep-runs", min=0, help="Keep what the last N runs used.")] = 5,
    dry_run: Annotated[bool, typer.Option("--dry-run", help="Say what would go; remove nothing.")] = False,
    as_json: JsonOption = False,
) -> None:
    """Remove artifacts that no recent run used, and leftovers of killed runs."""
    from scanloom.workflows.housekeeping import collect_garbage

    found = collect_garbage(_store_folder(store), keep_runs, dry_run)
    if as_json:
        _emit(found)
    else:
        verb = "would free" if dry_run else "freed"
        halves = f" and {found['leftovers']} leftovers" if found["leftovers"] else ""
        print(f"{verb} {found['bytes'] / 1e6:.1f} MB in {found['artifacts']} artifacts{halves}")


@app.command(hidden=True)
def warm() -> None:
    """Compile modules and numerical kernels once, so that the first map does not wait for it."""
    from scanloom.workflows.warming import compile_modules, is_warm, warm_kernels

    compile_modules()
    if is_warm():
        return
    _say("setup: compiling the numerical kernels (once per version of the code)")
    started = time.monotonic()
    warm_kernels()
    _say(f"setup: done in {time.monotonic() - started:.0f} s")


for _command in app.registered_commands:
    _command.epilog = epilog(str(_command.name or getattr(_command.callback, "__name__", "")))


if __name__ == "__main__":
    main()
