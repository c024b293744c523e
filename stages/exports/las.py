"""LAZ 1.4: the format of surveying, with a coordinate system as WKT."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from scanloom.stages.exports.clouds import clouds
from scanloom.stages.exports.coordinates import Projector
from scanloom.stages.exports.las_points import Records, Rows, las_header
from scanloom.stages.exports.options import Options
from scanloom.stages.exports.source import MapSource


def write_laz(source: MapSource, folder: Path, options: Options) -> list[Path]:
    """`map.laz`, and with `per_tile` also `tiles/X_Y.laz`: the same points, cut as the map's tiles."""
    projector = Projector.of(source, options)
    records = Records.of(source, projector, options)
    written = [folder / "map.laz"]
    if options.per_tile:
        (folder / "tiles").mkdir()
    with _open(written[0], projector, records) as whole:
        for cloud in clouds(source, projector, options):
            rows = records(cloud)
            _write(whole, rows)
            if options.per_tile and len(rows):
                written.append(folder / "tiles" / f"{cloud.name}.laz")
                with _open(written[-1], projector, records) as single:
                    _write(single, rows)
    return written


def _open(path: Path, projector: Projector, records: Records) -> Any:
    import laspy

    return laspy.open(path, mode="w", header=las_header(projector, records), do_compress=True)


def _write(writer: Any, rows: Rows) -> None:
    import laspy

    if len(rows):
        header = writer.header
        writer.write_points(
            laspy.ScaleAwarePointRecord(rows, header.point_format, header.scales, header.offsets)
        )
