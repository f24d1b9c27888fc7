"""Are the inputs accelerations where the model takes speeds?

A hovercraft's, a boat's or a car's pedal says how fast a speed grows. Lags of many minutes with gains of a hundred, and rate limits that
are never reached, together do the same, and would be named. So, where the model foretells little, the inputs that it takes for speeds are
replaced by

    c + g z,      z' = u - z / T        (a first-order lag; T without end: the integral of the input; c, g by least squares)

and E (`prediction_error`) is asked of all T. If the integral foretells well, and far better than any T up to a quarter of the recording and
the input itself do, then that is what the inputs are, and no effect is looked for.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from s2r_runtime.errors import ConfigError, RecordingError
from s2r_runtime.models.composed import ComposedModel
from s2r_runtime.trace.checks.prediction_error import shares, some_starts, steps_ahead, unforetold
from s2r_runtime.trace.data.dataset import Dataset
from s2r_runtime.trace.estimation.prediction import Acting, Index, acting, first_steps, rms, rollout

Array = NDArray[np.float64]

NOTHING, WELL = 0.35, 0.35
"""E from which a model foretells little, and below which it foretells well."""

BETTER = 0.5
"""Of E with the input itself, or with any lag that the recording could tell from an integral, which that of the integral must be below."""

LAGS_S = (0.5, 1.0, 2.0, 4.0, 8.0, 16.0, 32.0, 64.0)
"""T that are tried, s, up to a QUARTER of the longest run."""

QUARTER = 0.25

RUNS = 8
"""At most: each has a speed of its own at its start."""

SPEEDS = {"m/s", "rad/s"}

LITTLE = 1e-3
"""Of an input's size: the change by which slopes are told."""

TURNS = 3
"""Of Gauss-Newton: headings first, then the way along them."""


def check_accelerations(model: ComposedModel, data: Dataset) -> None:
    """Raises RecordingError if inputs that the model takes for speeds are clearly accelerations."""
    units: dict[str, str] = getattr(model.nominal, "units", {})
    speeds = [j for j, name in enumerate(model.inputs) if units.get(name) in SPEEDS]
    as_it_is = unforetold(model, data) if speeds and len(data.runs) <= RUNS else None
    if as_it_is is None or np.mean(as_it_is) <= NOTHING:
        return
    longest = max(len(run.y) for run in data.runs) * data.dt
    lags = [lag for lag in LAGS_S if lag <= QUARTER * longest]
    for columns in [speeds, *([j] for j in speeds if len(speeds) > 1)]:
        off = _off(model, data, columns, math.inf)
        if off < WELL and off < BETTER * min(float(np.mean(as_it_is)), *(_off(model, data, columns, lag) for lag in (0.0, *lags))):
            names = " and ".join(model.inputs[j] for j in columns)
            seem, must = ("seems to be an acceleration", "a speed") if len(columns) == 1 else ("seem to be accelerations", "speeds")
            raise RecordingError(
                f"{data.source}: {names} {seem}, must be {must}: so read, the model errs by {off:.0%} of the motion; as it is, by "
                f"{np.mean(as_it_is):.0%}"
            )


def _off(model: ComposedModel, data: Dataset, columns: list[int], lag: float) -> float:
    """Mean E with these inputs through a lag, s, with the gain and starts of runs that foretell best; infinite where nothing goes."""
    act, starts = acting(model, data), some_starts(data)
    terms = _terms(data, act.mean[:, columns], lag)
    told = np.zeros((len(columns), terms.shape[2]))
    error = _errors(model, data, starts, _with(act, columns, terms, told))
    if error is None:
        return math.inf
    scale = np.maximum(rms(error), 1e-300)  # with no input: how far each state goes
    by = LITTLE * np.std(act.mean[:, columns], axis=0)[:, None] / np.maximum(np.sqrt(np.mean(terms**2, axis=0)), 1e-300)
    for _ in range(TURNS):
        slopes = []
        for place in np.argwhere(by > 0.0):
            more = np.zeros_like(told)
            more[tuple(place)] = by[tuple(place)]
            moved = _errors(model, data, starts, _with(act, columns, terms, told + more))
            if moved is None:
                return math.inf
            slopes.append(((moved - error) / scale).ravel())
        if not slopes:
            return math.inf
        told[by > 0.0] -= by[by > 0.0] * np.linalg.lstsq(np.stack(slopes, axis=1), (error / scale).ravel(), rcond=1e-8)[0]
        error = _errors(model, data, starts, _with(act, columns, terms, told))
        if error is None:
            return math.inf
    found = shares(model, data, starts, error, None, pushed=False)
    return math.inf if found is None else float(np.mean(found))


def _terms(data: Dataset, u: Array, lag: float) -> Array:
    """(M, inputs, 1 + runs): z of each run from rest, and what is left of its start, over each step."""
    from scipy.linalg import lapack

    begin = first_steps(data)
    terms = np.zeros((*u.shape, 1 + len(data.runs)))
    for i, run in enumerate(data.runs):
        here, lasts = slice(begin[i], begin[i + 1]), run.durations(data.dt)
        if lag == 0.0:
            terms[here, :, 0], terms[here, :, 1 + i] = u[here], 1.0
        elif len(lasts):
            keep = np.exp(-lasts / lag)
            band = np.ones((2, len(lasts)))
            band[1, :-1] = -keep[1:]
            gains = lasts if math.isinf(lag) else lag * (1.0 - keep)
            after, _ = lapack.dtbtrs(band, gains[:, None] * u[here], uplo="L", diag="U")
            left = np.append(1.0, np.cumprod(keep))
            terms[here, :, 0] = 0.5 * (after + np.concatenate([np.zeros((1, u.shape[1])), after[:-1]]))
            terms[here, :, 1 + i] = 0.5 * (left[1:] + left[:-1])[:, None]
    return terms


def _with(act: Acting, columns: list[int], terms: Array, told: Array) -> Acting:
    """Inputs that act, with some of them replaced by their terms (M, inputs, k) times numbers (inputs, k)."""
    mean, end = act.mean.copy(), act.end.copy()
    mean[:, columns] = end[:, columns] = np.einsum("mik,ik->mi", terms, told)
    return Acting(mean, end, act.lasts)


def _errors(model: ComposedModel, data: Dataset, starts: Index, act: Acting) -> Array | None:
    """(n, nx) at the ends of rollouts; None where a model gives no numbers."""
    try:
        with np.errstate(all="ignore"):
            error = rollout(model, data, act, starts, steps_ahead(data)).error
    except ConfigError:
        return None
    return error if np.all(np.isfinite(error)) else None
