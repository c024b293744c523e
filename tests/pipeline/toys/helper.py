"""Arithmetic that a stage shares."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray


def rounded(values: NDArray[np.int64], step: int) -> NDArray[np.int64]:
    return values // step * step
