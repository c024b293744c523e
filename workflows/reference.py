"""Reference pages made from the code itself: what every column means, what every stage does and can be told."""

from __future__ import annotations

import inspect
import sys
from collections.abc import Iterable
from pathlib import Path

from pydantic import BaseModel

from scanloom.pipeline.node import Node
from scanloom.schemas.metrics import METRICS, MetricKind
from scanloom.schemas.product import Document, Files, Product, Stream, attributes_of, describe
from scanloom.workflows.map_session import NODES

METRICS_INTRODUCTION = """\
`metrics.json` beside a map holds a list of rows: `name`, `value`, `unit`, `scope` (`session`, `map` or `run`), `method` (how it
was computed, and from how many samples), `truth` (whether truth was needed), `samples` where it is no plain count, and
`session` in maps of several. Units stand at the end of the names; `*` stands for what varies: a radius, a length, a reason.

`scanloom compare A B` calls it a regression when a metric of B is worse than that of A by more than noise allows: with
`--noise`, by more than two runs of the same log differ once in a thousand times (Student's t, from the standard deviation of
the repeats); without, by more than the last column, the larger of a fixed amount and a share of the value in A.
"""
NOTE = "<!-- made from the code by `make docs`; do not edit -->\n\n"


def write_pages(folder: Path) -> None:
    """Write `products.md`, `stages.md`, `metrics.md` and one page per stage below `folder`."""
    for name, text in pages().items():
        path = folder / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text)


def pages() -> dict[str, str]:
    """Text of every reference page by its path below the folder of documents."""
    made = {"products.md": _products_page(), "stages.md": _stages_page(), "metrics.md": _metrics_page()}
    made |= {f"stages/{n.name}.md": _stage_page(n) for n in NODES}
    return made


def _products_page() -> str:
    seen: dict[str, type[Product]] = {}
    for n in NODES:
        for product in (*n.reads, *n.writes):
            seen.setdefault(product.NAME, product)
    return (
        NOTE
        + "# Products\n\n"
        + _first_paragraphs(sys.modules[Product.__module__].__doc__ or "")
        + "".join(_product_section(product) for product in seen.values())
    )


def _product_section(product: type[Product]) -> str:
    doc = inspect.cleandoc(product.__doc__ or "")
    text = f"\n## {product.NAME}\n\n{doc}\n"
    if product.SPLIT_BY:
        text += f"\nStored in parts, one per {product.SPLIT_BY}.\n"
    if issubclass(product, Document):
        rows = [(name, str(field.annotation), "", "", "") for name, field in product.model_fields.items()]
        return text + _table(("field", "type"), [row[:2] for row in rows])
    if issubclass(product, Files):
        return text
    columns = [
        (name, c.dtype + "".join(f"[{s}]" for s in c.shape), c.unit, c.frame, c.doc)
        for name, c in describe(product)
    ]
    text += _table(("column", "type", "unit", "frame", "meaning"), columns)
    item = product.ITEM if issubclass(product, Stream) else product
    footer = list(attributes_of(item).items())  # type: ignore[arg-type]
    return text + (_table(("in the footer", "meaning"), footer) if footer else "")


def _stages_page() -> str:
    rows = [
        (f"[{n.name}](stages/{n.name}.md)", n.per, _names(n.reads), _names(n.writes), _summary(n))
        for n in NODES
    ]
    return NOTE + "# Stages\n" + _table(("stage", "per", "reads", "writes", "what it does"), rows)


def _metrics_page() -> str:
    """One line per metric, from the list that `compare` judges by."""
    blocks = [NOTE, "# Metrics\n\n", METRICS_INTRODUCTION]
    for title, truth in (("Without truth", False), ("Against truth", True)):
        rows = [
            (f"`{kind.name}`", kind.doc, _better(kind), _shown_tolerance(kind))
            for kind in METRICS
            if kind.truth == truth
        ]
        blocks += [
            f"\n## {title}\n",
            _table(("metric", "what it is", "better", "no regression up to"), rows),
        ]
    return "".join(blocks)


def _better(kind: MetricKind) -> str:
    return f"near {kind.target:g}" if kind.better == "target" else kind.better or "–"


def _shown_tolerance(kind: MetricKind) -> str:
    """What `compare` allows when no noise was measured."""
    if not kind.better:
        return "not judged"
    if kind.varies:
        return "judged with measured noise only"
    parts = [f"{kind.absolute:g}"] * bool(kind.absolute) + [f"{100 * kind.relative:g} %"] * bool(
        kind.relative
    )
    return " or ".join(parts) or "any change for the worse is one"


def _stage_page(n: Node) -> str:
    module = sys.modules[n.stage.__module__]
    parts = [NOTE, f"# {n.name}\n\n", inspect.cleandoc(module.__doc__ or ""), "\n\n"]
    if n.stage.__doc__:
        parts += [inspect.cleandoc(n.stage.__doc__), "\n\n"]
    parts.append(f"Runs once per {n.per}. Reads {_names(n.reads) or 'nothing'}; writes {_names(n.writes)}.\n")
    parts += ["\n## Settings\n", _settings_section(n)]
    return "".join(parts)


def _settings_section(n: Node) -> str:
    owner = next(other for other in NODES if other.name == n.settings_of)
    if n is not owner and n.settings is owner.settings:
        return f"\nThose of [{owner.name}]({owner.name}.md).\n"
    return _settings_table(n)


def _settings_table(n: Node) -> str:
    rows = []
    for name, field in n.settings.model_fields.items():
        bounds = ", ".join(filter(None, (_bound(m) for m in field.metadata)))
        rows.append(
            (
                f"`{n.settings_of}.{name}`",
                f"`{_shown(field.get_default(call_default_factory=True))}`",
                bounds,
                field.description or "",
            )
        )
    return _table(("setting", "default", "bounds", "meaning"), rows) if rows else "\nNone.\n"


def _bound(constraint: object) -> str:
    for name, sign in (("ge", "≥"), ("gt", ">"), ("le", "≤"), ("lt", "<")):
        if hasattr(constraint, name):
            return f"{sign} {getattr(constraint, name):g}"
    return ""


def _shown(value: object) -> object:
    return value.model_dump() if isinstance(value, BaseModel) else value


def _summary(n: Node) -> str:
    doc = sys.modules[n.stage.__module__].__doc__ or ""
    return " ".join(doc.strip().split("\n\n")[0].split())


def _first_paragraphs(doc: str) -> str:
    return inspect.cleandoc(doc) + "\n"


def _names(products: Iterable[type[Product]]) -> str:
    return ", ".join(product.NAME for product in products)


def _table(head: tuple[str, ...], rows: Iterable[tuple[object, ...]]) -> str:
    lines = ["| " + " | ".join(head) + " |", "|" + "---|" * len(head)]
    lines += [
        "| " + " | ".join(str(c).replace("|", "\\|").replace("\n", " ") for c in row) + " |" for row in rows
    ]
    return "\n" + "\n".join(lines) + "\n"


if __name__ == "__main__":
    write_pages(Path(sys.argv[1]))
