"""Sessions that nothing ties to the rest: they are left out, so that one bad session does not stop the others."""

from __future__ import annotations

from collections import Counter
from collections.abc import Collection, Sequence
from dataclasses import replace

import numpy as np

from scanloom.schemas.errors import StageError
from scanloom.schemas.loops import Loops
from scanloom.stages.fusion.drives import Drive
from scanloom.stages.fusion.links import Link

LEFT_OUT = "is left out"
ONE_LOOP = "only one loop to them was found, which nothing confirms"


class Untied(StageError):
    """Sessions that have neither GNSS nor loops that tie them to those that have a place."""

    def __init__(
        self,
        what: str,
        *,
        where: str = "",
        next_step: str = "",
        names: Sequence[str] = (),
        anywhere: bool = True,
    ) -> None:
        super().__init__(what, where=where, next_step=next_step)
        self.names = frozenset(names)
        self.anywhere = anywhere
        """Whether the others have a place by GNSS or by the map that is extended, not only by being first."""

    @classmethod
    def of(
        cls, names: Sequence[str], *, anywhere: bool, loops: str = "no loop to them was accepted"
    ) -> Untied:
        """The error that names these sessions."""
        named = list(dict.fromkeys(names))
        return cls(
            f"nothing ties this session to the others: it has no usable GNSS and {loops}",
            where=f"session {', '.join(named)}",
            next_step="map it on its own, or add a session that overlaps both",
            names=named,
            anywhere=anywhere,
        )


def hanging_on_one(drives: Sequence[Drive], found: Sequence[Link], placed: Collection[int]) -> list[str]:
    """Sessions without a place that a single loop ties to the others: nothing can confirm it."""
    has_place = {drives[k].name for k in placed}
    ends = Counter(
        name
        for link in found
        for name in {drives[link.drive_i].name, drives[link.drive_j].name}
        if drives[link.drive_i].name != drives[link.drive_j].name
    )
    return [name for name, count in sorted(ends.items()) if count == 1 and name not in has_place]


def those_tied(
    drives: Sequence[Drive], found: Sequence[Link], lost: Untied, new: frozenset[str]
) -> list[Drive]:
    """The drives that make a map without the lost ones, numbered anew.

    Where none has a place these are the largest group that loops tie together. `new` are the sessions that an extension
    is made for.

    Raises
    ------
    Untied : one session is as good as the other, or no new one is left.
    """
    names = {d.name for d in drives}
    kept = names - lost.names if lost.anywhere else _largest_group(drives, found)
    if (new and not kept & new) or (not lost.anywhere and len(kept) == 1):
        raise lost
    out, first = [], 0
    for d in drives:
        if d.name in kept:
            out.append(replace(d, first_node=first))
            first += len(d.keyframes)
    return out


def loops_among(drives: Sequence[Drive], loops: Loops) -> Loops:
    """The loops between sessions that are left."""
    names = {d.name for d in drives}
    kept = [a in names and b in names for a, b in zip(loops.session_i, loops.session_j, strict=True)]
    return loops.take(np.array(kept, bool))


def left_out(before: Sequence[Drive], after: Sequence[Drive]) -> list[str]:
    """A sentence on each session that is not in the map."""
    names = dict.fromkeys(d.name for d in before)
    kept = {d.name for d in after}
    return [
        f"session {name} {LEFT_OUT}: it has no usable GNSS, and no loop that can be confirmed ties it to the others; map it on its own, or add a "
        "session that overlaps both"
        for name in names
        if name not in kept
    ]


def _largest_group(drives: Sequence[Drive], found: Sequence[Link]) -> set[str]:
    """Names of the sessions that loops join, most keyframes first; of equals the group with the first name."""
    group = {d.name: {d.name} for d in drives}
    for link in found:
        a, b = group[drives[link.drive_i].name], group[drives[link.drive_j].name]
        if a is not b:
            a |= b
            for name in b:
                group[name] = a
    size = {name: sum(len(d.keyframes) for d in drives if d.name in group[name]) for name in sorted(group)}
    return group[max(size, key=lambda name: size[name])]
