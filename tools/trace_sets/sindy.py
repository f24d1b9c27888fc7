"""PySINDy's STLSQ on the same residuals, for comparison: which terms does sparse regression keep?

    r_k = (y_{k+1} ⊖ f̂(y_k, u_k)) / dt, along and across the heading for robots that have one
    r ~ Θ ξ,  ξ by sequentially thresholded least squares

Θ holds what the tracer's own tests of what is left may speak of: a constant, inputs, their squares, products and sizes, each input as
it was some steps ago (less what it is now: delayed inputs, without which a lag could not be said), heading, position, speed, time and
time x input. Columns are scaled to 1. The threshold is the one with the least error on the last third, which the fit does not see; if
none foretells it better than no term at all, nothing is kept. The answer is what the term that explains most depends on. This is as
kind to it as one can be: names are not asked for.
"""

from __future__ import annotations

import warnings
from typing import Any

import numpy as np
from numpy.typing import NDArray

from s2r_runtime.models.composed import ComposedModel
from s2r_runtime.trace.data.dataset import Dataset

Array = NDArray[np.float64]

DELAYS = (1, 2, 4, 8, 16)
"""Steps."""

THRESHOLDS = tuple(float(x) for x in np.geomspace(0.01, 1.0, 9))
"""Of a coefficient, over the residual's standard deviation."""

FIT_SHARE = 0.65
BETTER = 0.99
"""Of the error without any term: terms that foretell no better than this are not kept."""

TOKENS: dict[str, tuple[str, ...]] = {
    "input_gain": ("{c}", "{s}"),
    "input_gain_asymmetry": ("{c}",),
    "input_bias": ("constant",),
    "input_delay": ("memory({c})", "{s}"),
    "input_lag": ("memory({c})", "{s}"),
    "input_rate_limit": ("memory({c})", "{s}"),
    "input_saturation": ("{c}",),
    "wheel_saturation": ("v", "w", "v*w"),
    "input_deadband": ("{c}",),
    "input_backlash": ("memory({c})", "{c}", "{s}"),
    "input_coupling": ("{from}",),
    "input_gain_drift": ("time*{c}", "{c}"),
    "regime_change": ("time*{c}", "{c}"),
    "integration_scheme": ("{i0}*{i1}",),
    "viscous_friction": ("speed",),
    "coulomb_friction": ("speed",),
    "stribeck_friction": ("speed",),
    "quadratic_drag": ("speed", "{c}"),
    "cubic_stiffness": ("position",),
    "constant_disturbance": ("constant", "heading"),
    "gravity_slope": ("heading",),
    "lateral_slip": ("{i0}*{i1}", "{i0}", "{i1}"),
    "longitudinal_slip": ("{i0}", "{i1}"),
    "track_scale": ("{i0}", "{i1}", "{i0}*{i1}"),
    "understeer": ("{i0}*{i1}", "{i0}", "{i1}"),
    "heading_offset": ("{i0}", "{i1}"),
    "sensor_offset": ("constant",),
    "sensor_lever_arm": ("{i0}", "{i1}", "{i0}*{i1}"),
    "periodic_disturbance": ("time",),
    "position_field": ("position",),
    "mass_change": ("{c}",),
}
"""Effect -> tokens of terms that would be right for it. {c}: its channel, {s}: the states that follow it, {i0}, {i1}: the inputs."""


def available() -> bool:
    """Whether PySINDy is installed."""
    import importlib.util

    return importlib.util.find_spec("pysindy") is not None


def answer(data: Dataset, nominal: ComposedModel) -> dict[str, Any]:
    """`terms`: how many were kept; `top`: the token of the strongest one, or nothing."""
    from pysindy import STLSQ

    r, theta, tokens = _problem(data, nominal)
    cut = int(FIT_SHARE * len(r))
    if cut < 4 * len(tokens) or len(tokens) == 0:
        return {"terms": 0, "top": None}
    scale, size = np.std(theta[:cut], axis=0) + 1e-12, np.std(r[:cut], axis=0) + 1e-12
    offset = np.array([float(t != "constant") for t in tokens]) * np.mean(theta[:cut], axis=0)
    columns = (theta - offset) / np.where(np.array(tokens) == "constant", 1.0, scale)
    wanted = r / size
    best = float(np.mean(wanted[cut:] ** 2)) * BETTER**2
    kept: Array = np.zeros((wanted.shape[1], len(tokens)))
    for threshold in THRESHOLDS:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            found = np.asarray(STLSQ(threshold=threshold, alpha=1e-3).fit(columns[:cut], wanted[:cut]).coef_)
        error = float(np.mean((wanted[cut:] - columns[cut:] @ found.T) ** 2))
        if error < best:
            best, kept = error, found
    strength = np.sum(kept**2, axis=0)
    return {"terms": int(np.count_nonzero(kept)), "top": tokens[int(np.argmax(strength))] if strength.any() else None}


def _problem(data: Dataset, nominal: ComposedModel) -> tuple[Array, Array, list[str]]:
    """r (n, nr), Θ (n, m) and its tokens, over all runs."""
    parts = []
    for run in data.runs:
        u = run.u.reshape(len(run.y) - 1, data.substeps, -1).mean(axis=1)
        y0, y1 = run.y[:-1], run.y[1:]
        hidden = nominal.at_rest(len(u))
        predicted, _ = nominal.step(np.nan_to_num(y0), u, hidden)
        r = nominal.difference(y1.copy(), predicted) / data.dt
        theta, tokens = _terms(y0, u, run.start_s + data.dt * np.arange(len(u)), nominal)
        good = ~(np.isnan(r).any(axis=1) | np.isnan(theta).any(axis=1))
        good[: max(DELAYS)] = False
        parts.append((_body(r, y0, nominal)[good], theta[good]))
    return np.concatenate([p[0] for p in parts]), np.concatenate([p[1] for p in parts]), tokens


def _body(r: Array, y: Array, nominal: ComposedModel) -> Array:
    if "theta" not in nominal.states:
        return r[:, len(nominal.states) // 2 :]
    c, s = np.cos(y[:, 2]), np.sin(y[:, 2])
    return np.column_stack([r[:, 0] * c + r[:, 1] * s, r[:, 1] * c - r[:, 0] * s, r[:, 2:]])


def _terms(y: Array, u: Array, t: Array, nominal: ComposedModel) -> tuple[Array, list[str]]:
    columns, tokens = [np.ones(len(u))], ["constant"]

    def add(column: Array, token: str) -> None:
        columns.append(column)
        tokens.append(token)

    inputs = nominal.inputs
    for j, name in enumerate(inputs):
        for column in (u[:, j], u[:, j] ** 2, np.abs(u[:, j]), u[:, j] ** 3):
            add(column, name)
        add(t * u[:, j], f"time*{name}")
        for d in DELAYS:
            add(np.concatenate([np.zeros(d), u[:-d, j]]) - u[:, j] if len(u) > d else np.zeros(len(u)), f"memory({name})")
    if len(inputs) > 1:
        for column in (u[:, 0] * u[:, 1], u[:, 0] * u[:, 1] ** 2, u[:, 0] ** 2 * u[:, 1]):
            add(column, f"{inputs[0]}*{inputs[1]}")
    if "theta" in nominal.states:
        for column in (np.cos(y[:, 2]), np.sin(y[:, 2])):
            add(column, "heading")
        positions, speeds = [0, 1], list(range(3, len(nominal.states)))
    else:
        half = len(nominal.states) // 2
        positions, speeds = list(range(half)), list(range(half, 2 * half))
    for k in positions:
        for column in (y[:, k], y[:, k] ** 3):
            add(column, "position")
    for k in speeds:
        for column in (y[:, k], y[:, k] * np.abs(y[:, k]), np.sign(y[:, k])):
            add(column, "speed" if "theta" not in nominal.states else nominal.states[k])
    add(t - np.mean(t), "time")
    return np.column_stack(columns), tokens


def right_tokens(effects: list[dict[str, Any]], inputs: tuple[str, ...], follows: dict[str, str]) -> set[str]:
    """Tokens of terms that would be right for these effects. follows: input -> the state that is set to it."""
    found: set[str] = set()
    for e in effects:
        for channel in inputs if e["channel"] == "*" else (e["channel"],):
            words = {
                "c": channel,
                "s": follows.get(channel, channel),
                "from": e["parameters"].get("from", ""),
                "i0": inputs[0],
                "i1": inputs[-1],
            }
            found |= {token.format(**words) for token in TOKENS[e["name"]]}
    return found
