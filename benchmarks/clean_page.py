"""The figures of cleaning as tables, for the screen and for the page of the documentation."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path

from benchmarks.scores import Figure

PREFIX = "bench.clean."
START, END = "<!-- figures of cleaning: start -->", "<!-- figures of cleaning: end -->"
COLUMNS = {
    "sa_percent": "SA %", "da_percent": "DA %", "aa_percent": "AA %", "ha_percent": "HA %", "mme_before": "MME before",
    "mme_after": "after", "localisation_before_percent": "home % before", "localisation_after_percent": "after",
    "localisation_failures": "failures", "ms_per_scan": "ms",
}  # fmt: skip
PARTS = ("range_", "kind_")
KEPT = ("sa_percent", "da_percent", "worst_sa_percent", "worst_da_percent")

ByName = Mapping[str, Figure]


def fill(page: Path, figures: Sequence[Figure], remark: str) -> None:
    """Put the tables between the marks of `page`."""
    before, rest = page.read_text().split(START)
    _, after = rest.split(END)
    page.write_text("\n".join((f"{before}{START}\n", remark, "", *tables(figures), f"\n{END}{after}")))


def tables(figures: Sequence[Figure]) -> Iterator[str]:
    """Lines of Markdown: by scene and system, then by range and kind."""
    known = {tuple(figure.name.removeprefix(PREFIX).split(".", 2)): figure for figure in figures}
    rows = list(dict.fromkeys(key[:2] for key in known))
    yield from _table(
        ("scene", "system", *COLUMNS.values()),
        ((*row, *(_cell(known.get((*row, name))) for name in COLUMNS)) for row in rows),
    )
    yield ""
    systems = list(dict.fromkeys(system for _, system in rows))
    parts = dict.fromkeys((key[0], key[2].rpartition(".")[0]) for key in known if key[2].startswith(PARTS))
    yield from _table(
        ("scene", "points", *(f"{system} {name.removesuffix('_percent')}" for system in systems for name in KEPT)),
        (
            (scene, part, *(_cell(known.get((scene, system, f"{part}.{name}"))) for system in systems for name in KEPT))
            for scene, part in parts
        ),
    )  # fmt: skip


def _table(head: Sequence[str], rows: Iterator[tuple[str, ...]]) -> Iterator[str]:
    yield f"| {' | '.join(head)} |"
    yield "|" + "---|" * len(head)
    for row in rows:
        yield f"| {' | '.join(row)} |"


def _cell(figure: Figure | None) -> str:
    """Shares with two places, so that 98.5 is told from 98.45."""
    if figure is None:
        return ""
    if figure.unit == "%":
        return f"{figure.value:.2f}"
    return f"{figure.value:.0f}" if abs(figure.value) >= 1000 else f"{figure.value:.4g}"
