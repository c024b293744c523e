"""Compile the numerical kernels ahead of the first map, by mapping a few simulated seconds."""

from __future__ import annotations

import tempfile
from pathlib import Path

from scanloom.stages.geometry.kernels import cache_folder, remember_signatures
from scanloom.workflows.build_map import Order, build_map
from scanloom.workflows.sessions import SAMPLE

MARKER = "warm"


def is_warm() -> bool:
    """Whether this version of the code was compiled on this machine."""
    return (cache_folder() / MARKER).exists()


def warm_kernels() -> None:
    """Map the small sample in a throwaway store; the compiled kernels stay."""
    with tempfile.TemporaryDirectory(prefix="scanloom-warm-") as scratch:
        order = Order(
            sessions=(SAMPLE,),
            out=Path(scratch) / "map",
            name=SAMPLE,
            store=Path(scratch) / "store",
            cluster="none",
            command_line={"simulate": {"size": "small"}},
        )
        outcome = build_map(order)
    for _, error in outcome.failures:
        raise error
    remember_signatures()
    (cache_folder() / MARKER).touch()
