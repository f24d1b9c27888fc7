"""How much of the motion a model foretells if it may be off in size, and every state by itself.

    E'_i = min_s |dy_i - s df_i| / |dy_i|,   LEAST <= s <= MOST     (trimmed rms, over H steps of half a second)

df: the sum of what the model says of each of the H steps from the states that were measured there, so that a robot that turns a third as
far as it should still goes where its heading says. Of speeds that forces change, both are taken without what friction of any size would
do to them (dry, viscous, a steady push): a slow drive's motor fights little else. `prediction_error` asks for all of the motion: of a model
that lacks much it says that it foretells nothing, whether columns are exchanged or not.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from s2r_runtime.models.composed import ComposedModel
from s2r_runtime.models.forces import axes
from s2r_runtime.trace.checks.prediction_error import FEWEST_STARTS, GOES, bend_noise, some_starts, steps_ahead, trimmed
from s2r_runtime.trace.data.dataset import Dataset
from s2r_runtime.trace.data.missing_rows import filled
from s2r_runtime.trace.estimation.prediction import acting, advanced, first_steps

Array = NDArray[np.float64]

LEAST, MOST, SIZES = 0.2, 2.0, 13
"""Times what it foretells a state may go, and sizes that are tried: wheels slip, loads are heavy, motors weak. Units are farther off."""


def loosely_unforetold(model: ComposedModel, data: Dataset, *, pushed: bool = False) -> Array | None:
    """(nx,) E' of each state, at most 2, NaN of one that goes nowhere; None where too little is known. pushed: less a steady push."""
    ways = _ways(model, data)
    if ways is None:
        return None
    y, f, _ = ways
    goes = trimmed(y) > GOES * bend_noise(data) + 1e-12
    y, f = _less_friction(model, ways)
    went = trimmed(y)
    left = (y - s * f for s in (1.0, *np.geomspace(LEAST, MOST, SIZES)))
    off = np.min([trimmed(e - np.median(e, axis=0) if pushed else e) for e in left], axis=0)
    return np.where(goes, np.minimum(off / np.maximum(went, 1e-300), 2.0), np.nan)


def sizes(model: ComposedModel, data: Dataset) -> Array:
    """(nx,) times what it was foretold each state went, by least squares over the rows that this foretells best; NaN if unknown."""
    ways = _ways(model, data)
    if ways is None:
        return np.full(len(model.states), np.nan)
    y, f = _less_friction(model, ways)
    size = np.ones(y.shape[1])
    for _ in range(5):
        off = np.abs(y - size * f)
        usual = off <= np.quantile(off, 0.8, axis=0)
        size = np.sum(usual * y * f, axis=0) / np.maximum(np.sum(usual * f * f, axis=0), 1e-300)
    return np.asarray(size)


def heading_off(model: ComposedModel, data: Dataset) -> float | None:
    """Rad by which the way of a robot in a plane goes aside of its heading, all in all."""
    ways = _ways(model, data)
    if ways is None:
        return None
    x, y = (model.states.index(name) for name in ("x", "y"))
    gone, told = (way[:, x] + 1j * way[:, y] for way in ways[:2])
    return float(np.angle(np.sum(gone * np.conj(told))))


def _less_friction(model: ComposedModel, ways: tuple[Array, Array, Array]) -> tuple[Array, Array]:
    """Speeds of axes less what friction of a size that suits each would do to them."""
    y, f, rubbed = ways[0].copy(), ways[1].copy(), ways[2]
    for axis in axes(model.nominal):
        v = axis.velocity
        table = np.column_stack([np.ones(len(y)), rubbed[:, v], rubbed[:, y.shape[1] + v]])
        for way in (y, f):
            way[:, v] -= table @ np.linalg.lstsq(table, way[:, v], rcond=1e-9)[0]
    return y, f


def _ways(model: ComposedModel, data: Dataset) -> tuple[Array, Array, Array] | None:
    """(n, nx) how far states went from each start, and how far they should have, (n, 2 nx) sums of signs and of states meanwhile; None if
    there are too few.
    """
    starts, ahead = some_starts(data), steps_ahead(data)
    if not len(starts):
        return None
    act, begin = acting(model, data), first_steps(data)
    set_by_input = [model.states.index(s) for s in model.nominal.reached if s in model.states]
    gone, foretold, rubbed = [], [], []
    for i, run in enumerate(data.runs):
        first = starts[(starts >= begin[i]) & (starts < begin[i] + len(run.y) - 1)] - begin[i]
        if not len(first):
            continue
        y, lasts = filled(run.y), run.durations(data.dt)[:, None]
        with np.errstate(all="ignore"):
            after = advanced(model, y[:-1], act, slice(int(begin[i]), int(begin[i]) + len(y) - 1))
        each = np.concatenate([model.difference(after, y[:-1]), np.sign(y[:-1]) * lasts, y[:-1] * lasts], axis=1)
        each = np.concatenate([each, ~np.isfinite(each).all(axis=1, keepdims=True)], axis=1)
        total = np.concatenate([np.zeros((1, each.shape[1])), np.cumsum(np.nan_to_num(each), axis=0)])
        within = total[first + ahead] - total[first]
        first, within = first[within[:, -1] == 0.0], within[within[:, -1] == 0.0, :-1]
        way, rub = np.split(within, [y.shape[1]], axis=1)
        way[:, set_by_input] = after[first + ahead - 1][:, set_by_input] - y[first][:, set_by_input]
        gone.append(y[first + ahead] - y[first])  # angles are without jumps: in so long, some turn more than once
        foretold.append(way)
        rubbed.append(rub)
    if sum(map(len, gone)) < FEWEST_STARTS:
        return None
    ways = np.concatenate(gone), np.concatenate(foretold), np.concatenate(rubbed)
    known = np.isfinite(np.concatenate(ways, axis=1)).all(axis=1)
    return (ways[0][known], ways[1][known], ways[2][known]) if np.count_nonzero(known) >= FEWEST_STARTS else None
