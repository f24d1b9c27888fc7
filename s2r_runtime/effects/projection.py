"""A residual seen along the direction in which a channel pushes the state, outliers held back.

For residuals r_k (n, nx) that a disturbance s_k pushes by p_k s_k:   d_k = p_k . r_k,   w_k = |p_k|²,   so that d_k = w_k s_k + noise of
variance ~ w_k. A row whose d_k / sqrt(w_k) is farther out than three times what all but a tenth stay within is set to that: one wild
measurement must not found a sine. (Of normal noise that is five standard deviations; what changes for a tenth of the time is left alone.)
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

FAR, USUAL = 3.0, 0.9


def along(residual: Array, pushes: Array) -> tuple[Array, Array]:
    """(d, w), each (n,)."""
    d, w = np.sum(pushes * residual, axis=1), np.sum(pushes * pushes, axis=1)
    size = np.sqrt(w)
    there = size > 0.0
    if not np.any(there):
        return d, w
    limit = FAR * float(np.quantile(np.abs(d[there] / size[there]), USUAL))
    return (np.clip(d, -limit * size, limit * size) if limit > 0.0 else d), w
