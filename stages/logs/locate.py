"""What the user calls a SESSION: which files are the log, which are the truth, and what the session file adds."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from scanloom.schemas.errors import InvalidInput
from scanloom.schemas.session import RawLog, TruthLog
from scanloom.stages.logs.formats import SCAN_SUFFIXES, detect, stem_of

ACCEPTED = (
    "a .bag, .mcap or .db3 file, a rosbag2 folder, a folder of split bags, a KITTI raw or odometry folder, "
    "a folder of PCD, PLY or .bin scans, or a session.yaml"
)
SESSION_FILES = ("session.yaml", "session.yml")
_DEEPEST = 2
_TRUTH_NAMES = ("truth", "ground_truth", "gt")
_KITTI_PARTS = ("/velodyne_points/", "/oxts/", "/image_00/", "/image_01/", "/image_02/", "/image_03/")
_PICTURES = (".png", ".jpg")
_MAGICS = {
    ".bag": (b"#ROSBAG V2.0", b"#ROSBAG V1"),
    ".mcap": (b"\x89MCAP0\r\n",),
    ".db3": (b"SQLite format 3\0",),
    ".zstd": (b"\x28\xb5\x2f\xfd",),
}


@dataclass(frozen=True)
class Located:
    """A session on disk."""

    name: str
    """Suggested name of the session."""
    format: str
    raw_log: RawLog
    truth_log: TruthLog = TruthLog()
    settings: dict[str, dict[str, Any]] = field(default_factory=dict)
    """Settings of stages that the session file gives, by stage."""


def locate(path: Path) -> Located:
    """Find out what `path` is. Reads names and first bytes only.

    Raises
    ------
    InvalidInput : nothing is there, it is no log, or it is not clear which of several logs is meant.
    UsageError : a session file has an unknown key.
    """
    if not path.exists():
        raise InvalidInput("There is no such file or folder.", where=str(path), next_step=f"give {ACCEPTED}")
    try:
        return _found(path)
    except OSError as error:
        raise InvalidInput(
            f"It cannot be read ({error.strerror}).", where=str(path), next_step="check its permissions"
        ) from error


def _found(path: Path) -> Located:
    if path.is_dir():
        return _folder(path)
    if path.name in SESSION_FILES or path.suffix in (".yaml", ".yml"):
        if path.name == "metadata.yaml":
            return _folder(path.parent)
        from scanloom.stages.logs.session_file import read_session_file

        return read_session_file(path)
    return _file(path)


def _file(path: Path) -> Located:
    check_file(path)
    if path.suffix.lower() in SCAN_SUFFIXES:
        raise InvalidInput(
            "This is a single scan; a map needs several.",
            where=str(path),
            next_step="give the folder of the scans",
        )
    found = detect([path.name])
    names = [path.name]
    truth = truth_in(path.parent / "truth")
    # a database whose recorder died keeps its last messages in a file beside it
    if path.with_name(path.name + "-wal").is_file():
        names.append(path.name + "-wal")
    return Located(stem_of(path.name), found, RawLog(path.resolve().parent, tuple(names)), truth)


def check_file(path: Path) -> None:
    """The file can be read, is not empty, and begins as its name says.

    Raises
    ------
    InvalidInput : it does not.
    """
    with path.open("rb") as stream:
        head = stream.read(4096)
    if not head:
        raise InvalidInput(
            "The file is empty.",
            where=str(path),
            next_step="copy or record the log again; its recorder wrote nothing",
        )
    suffix = path.suffix.lower() if path.suffix != ".active" else ".bag"
    if suffix in _MAGICS:
        if head.startswith(_MAGICS[suffix]):
            return
        holds = _what_it_is(head)
        raise InvalidInput(
            f"The file is named {path.suffix} but holds {holds}.",
            where=str(path),
            next_step=f"give {ACCEPTED}",
        )
    known = next((ending for ending, magics in _MAGICS.items() if head.startswith(magics)), "")
    if known:
        raise InvalidInput(
            f"The name does not say so, but this is a {known} file.",
            where=str(path),
            next_step=f"rename it so that it ends in {known}",
        )
    if suffix not in SCAN_SUFFIXES:
        raise InvalidInput(
            f"This is no log: {_what_it_is(head)}.", where=str(path), next_step=f"give {ACCEPTED}"
        )


def _what_it_is(head: bytes) -> str:
    for suffix, magics in _MAGICS.items():
        if head.startswith(magics):
            return f"a {suffix} file; rename it"
    if not head.strip(b"\0"):
        return "nothing but zeros; it was not copied completely"
    printable = sum(32 <= byte < 127 or byte in b"\t\r\n" for byte in head)
    return "plain text" if printable > 0.95 * len(head) else "something that is no known log"


def _folder(path: Path, depth: int = 0) -> Located:
    files = sorted(p for p in path.iterdir() if p.is_file())
    session = [p for p in files if p.name in SESSION_FILES]
    if session:
        return locate(session[0])
    for attempt in (_kitti_raw, _kitti_odometry, _bags, _scans):
        found = attempt(path, files)
        if found is not None:
            return found
    found = _only_child(path, depth) if depth < _DEEPEST else None
    if found is not None:
        return found
    holds = f"it holds {files[0].name}" if files else "it is empty"
    more = f" and {len(files) - 1} more files" if len(files) > 1 else ""
    raise InvalidInput(
        f"The folder holds no log that is known; {holds}{more}.",
        where=str(path),
        next_step=f"give {ACCEPTED}",
    )


# -- KITTI ----------------------------------------------------------------------------------------------------------


def _kitti_raw(path: Path, files: Sequence[Path]) -> Located | None:
    drives = [path] if (path / "velodyne_points").is_dir() else _drives(path) or [
        drive for date in sorted(path.iterdir()) if date.is_dir() for drive in _drives(date)
    ]  # fmt: skip
    if not drives:
        return None
    if len(drives) > 1:
        names = ", ".join(drive.name for drive in drives[:5])
        raise InvalidInput(
            f"The folder holds {len(drives)} drives: {names}.", where=str(path), next_step="give one of them"
        )
    drive = drives[0].resolve()
    root = drive.parent
    inside = [p.relative_to(root).as_posix() for p in _walk(drive)]
    calibration = [p.name for p in sorted(root.glob("calib_*.txt"))]
    oxts = tuple(name for name in inside if "/oxts/" in name)
    imu_to_velo = tuple(name for name in calibration if name == "calib_imu_to_velo.txt")
    scans = tuple(name for name in inside if any(part in name for part in _KITTI_PARTS))
    truth = TruthLog(root, (*oxts, *imu_to_velo)) if oxts else TruthLog()
    return Located(drive.name, "kitti raw", RawLog(root, tuple(sorted((*scans, *calibration)))), truth)


def _drives(path: Path) -> list[Path]:
    return sorted(p for p in path.iterdir() if (p / "velodyne_points").is_dir())


def _kitti_odometry(path: Path, files: Sequence[Path]) -> Located | None:
    if not any((path / "velodyne").glob("*.bin")):
        return None
    root = path.resolve()
    scans = [f"velodyne/{p.name}" for p in sorted((root / "velodyne").glob("*.bin"))]
    extra = [name for name in ("times.txt", "calib.txt") if (root / name).is_file()]
    images = [
        f"{p.parent.name}/{p.name}" for p in sorted(root.glob("image_[0-3]/*")) if p.suffix in _PICTURES
    ]
    poses = [
        p for p in (root / "poses.txt", root.parent.parent / "poses" / f"{root.name}.txt") if p.is_file()
    ]
    truth = TruthLog()
    if poses:
        truth_root = root if poses[0].parent == root else root.parent.parent
        names = [poses[0], *(root / name for name in extra)]
        truth = TruthLog(truth_root, tuple(p.relative_to(truth_root).as_posix() for p in names))
    return Located(f"kitti-{root.name}", "kitti odometry", RawLog(root, (*scans, *extra, *images)), truth)


# -- bags and scans -----------------------------------------------------------------------------------------------------


def _bags(path: Path, files: Sequence[Path]) -> Located | None:
    bags = [
        p for p in files if detect([p.name]) in ("rosbag1", "rosbag2", "mcap") and p.name != "metadata.yaml"
    ]
    if not bags:
        return None
    kinds = {detect([p.name]) for p in bags}
    if len(kinds) > 1:
        names = ", ".join(p.name for p in bags[:5])
        raise InvalidInput(
            f"The folder holds logs of several formats: {names}.",
            where=str(path),
            next_step="give one of these files",
        )
    scans = [p for p in files if p.suffix.lower() in SCAN_SUFFIXES]
    if len(scans) > 1:
        raise InvalidInput(
            f"The folder holds both bags ({bags[0].name}) and single scans ({scans[0].name}); it is not clear which is meant.",
            where=str(path),
            next_step=f"give {bags[0].name}, or move the scans to a folder of their own",
        )
    for bag in bags:
        if bag.stat().st_size or len(bags) == 1:
            check_file(bag)
    held = [p.name for p in files if p in bags or p.name == "metadata.yaml" or p.name.endswith(".db3-wal")]
    found = detect(held)
    return Located(path.resolve().name, found, RawLog(path.resolve(), tuple(held)), truth_beside(path))


def _scans(path: Path, files: Sequence[Path]) -> Located | None:
    scans = [p for p in files if p.suffix.lower() in SCAN_SUFFIXES]
    if not scans:
        return None
    suffixes = sorted({p.suffix.lower() for p in scans})
    if len(suffixes) > 1:
        raise InvalidInput(
            f"The folder holds scans of several formats ({', '.join(suffixes)}); it is not clear which are meant.",
            where=str(path), next_step="move the ones to be mapped to a folder of their own",
        )  # fmt: skip
    if len(scans) == 1:
        raise InvalidInput(
            f"The folder holds a single scan ({scans[0].name}); a map needs several.", where=str(path),
            next_step="give a folder with all scans of the drive",
        )  # fmt: skip
    extra = [p.name for p in files if p.name in ("times.txt", "timestamps.txt")]
    root = path.resolve()
    return Located(
        root.name, "point files", RawLog(root, (*(p.name for p in scans), *extra)), truth_beside(path)
    )


def _only_child(path: Path, depth: int) -> Located | None:
    """A folder around the log: of the folders in it, the one that is a log."""
    found: list[Located] = []
    for child in sorted(p for p in path.iterdir() if p.is_dir() and p.name.lower() not in _TRUTH_NAMES):
        try:
            found.append(_folder(child, depth + 1))
        except (InvalidInput, OSError):
            continue
    if len(found) > 1:
        names = ", ".join(log.name for log in found[:5])
        raise InvalidInput(
            f"The folder holds {len(found)} logs: {names}.", where=str(path), next_step="give one of them"
        )
    if not found:
        return None
    log = found[0]
    truth = log.truth_log if log.truth_log.names else truth_beside(path)
    return Located(path.resolve().name, log.format, log.raw_log, truth, log.settings)


def truth_beside(path: Path) -> TruthLog:
    """Truth in a folder `truth` inside or beside the log's folder."""
    inside = truth_in(path / "truth")
    return inside if inside.names else truth_in(path.resolve().parent / "truth")


def truth_in(folder: Path) -> TruthLog:
    """All files of the folder; no files when there is no such folder."""
    if not folder.is_dir():
        return TruthLog()
    root = folder.resolve()
    return TruthLog(root, tuple(p.relative_to(root).as_posix() for p in _walk(root)))


def _walk(folder: Path) -> list[Path]:
    return sorted(p for p in folder.rglob("*") if p.is_file())
