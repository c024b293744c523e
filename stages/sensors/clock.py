"""When a measured time offset is worth correcting."""

from __future__ import annotations

from scanloom.stages.sensors.agreement import Agreement

CLEAR = 4.0
LEAST_OFFSET_S = 0.002
LARGEST_STD_S = 0.02


def clear_offset(found: Agreement) -> float:
    """The offset, s, when it is sure and not negligible; else zero."""
    sure = found.lag_std_s < LARGEST_STD_S and abs(found.lag_s) > CLEAR * found.lag_std_s
    return found.lag_s if sure and abs(found.lag_s) > LEAST_OFFSET_S else 0.0


def said_of_clock(sensor: str, found: Agreement, corrected_s: float) -> str:
    """What was found about the clock, in a sentence."""
    late = "late" if found.lag_s > 0 else "early"
    size = f"{abs(found.lag_s) * 1e3:.1f} ms {late}, give or take {found.lag_std_s * 1e3:.1f} ms"
    if corrected_s != 0.0:
        return f"{sensor}: its stamps are {size}; corrected."
    if found.lag_std_s >= LARGEST_STD_S:
        return f"{sensor}: the motion does not tell whether its clock is right."
    return f"{sensor}: its clock agrees with the LiDAR's ({size})."
