"""Are outlying steps shocks of the process, or single measurements that are off?

A measurement that is off by e leaves r = e in the step that ends there and -F e in the next one: with

    s_k = r_k,      s_{k+j} = r_{k+j} + F_{k+j} s_{k+j-1}

s, where the measurements are less where the model goes on to from before step k, is back within the noise as soon as the measurements are.
What hits the robot itself stays: s goes on as F lets it. Some wild rows on end come back together. (So far as F is the same there: a
heading that is off by half a radian leaves more of the way than F says. Rows so wild are taken out before, as faults.) Where F forgets all
within a step (a speed that is set anew), and where a run ends, the two cannot be told apart.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

FEWEST, A_PART = 5, 0.25
"""Steps of shocks, and what part of the outlying steps that can be told these are, from which on noise of the process is asked about."""

SHORT = 3
"""Outlying steps on end at most: what goes on longer is no shock (an end stop). So many steps later what was off must be back, too."""


def are_shocks(r: Array, f: Array, joined: Mask, far: Array) -> bool:
    """Whether a good part of the steps r (n, nx) that are outlying, beyond far (nx,) in some state, are shocks. f: (n, nx, nx); joined:
    (n,) whether a step begins where the one before ended.
    """
    outlying = np.any(np.abs(r) > far, axis=1)
    stays, told = _staying(outlying, r, f, joined, far)
    shocks = stays & ~_going_on(outlying, joined)
    return bool(np.count_nonzero(shocks) >= max(FEWEST, A_PART * np.count_nonzero(told)))


def _staying(outlying: Mask, r: Array, f: Array, joined: Mask, far: Array) -> tuple[Mask, Mask]:
    """(n,) each: which outlying steps take the robot somewhere else for good, and of which that can be told."""
    follows = np.append(joined[1:], False)
    seen, back = np.zeros_like(outlying), np.zeros_like(outlying)
    at, off = np.flatnonzero(outlying), r[outlying]
    for later in range(1, SHORT + 1):
        goes_on = follows[at + later - 1]
        at, off = at[goes_on], np.einsum("kij,kj->ki", f[at[goes_on] + later], off[goes_on])
        visible = np.any(np.abs(off) > far, axis=1)  # else F has forgotten it, and it need not come back
        seen[at[visible]] = True
        at, off = at[visible], off[visible] + r[at[visible] + later]
        returns = np.all(np.abs(off) <= far, axis=1)
        for step in range(later + 1):
            back[at[returns] + step] = True
        at, off = at[~returns], off[~returns]
    return outlying & seen & ~back, outlying & (seen | back)


def _going_on(outlying: Mask, joined: Mask) -> Mask:
    """(n,) which outlying steps are of more than SHORT on end."""
    begins = outlying & ~(np.append(False, outlying[:-1]) & joined)
    which = np.cumsum(begins) * outlying
    return np.asarray(outlying & (np.bincount(which)[which] > SHORT))
