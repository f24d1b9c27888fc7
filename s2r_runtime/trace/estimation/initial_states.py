"""Where rollouts begin that are to tell models apart, if the speed of an axis was not measured: where the axis was, by the model itself.

The whitened residual z of a model says what the errors of the measurements were, under that model and its noise: with s = S^-1 r = L^-T z,

    e_k = R (s_{k-1} - F_k' s_k),       y_k - e_k: position and speed, smoothed        (s_{k-1} = 0 where step k begins anew)

A speed that was smoothed under another model would take its side. Errors of such a speed are no errors of a measurement: models are
told apart by those of what was measured. Where a hidden state of somebody's own model is told by others, its law may bend, and models are
told apart about where each of them has it (`retold`).
"""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from s2r_runtime.trace.data.dataset import Dataset
from s2r_runtime.trace.estimation import noise as noises
from s2r_runtime.trace.estimation.prediction import Steps

if TYPE_CHECKING:
    from s2r_runtime.trace.estimation.problem import Fit, Problem

Array = NDArray[np.float64]


def begun(given: Problem, fit: Fit) -> Array | None:
    """(rows of the runs laid end to end, nx) smoothed under the model; None where every state was measured."""
    if not given.floor.axes:
        return None
    steps = given.steps
    y = np.concatenate([run.y for run in given.data.runs])
    y[steps.place + steps.run] = steps.y0 - _errors(given, fit)[0]
    return y


def retold(given: Problem, fit: Fit) -> Steps:
    """The transitions with the states that were not measured where the model has them."""
    unseen = [v for _, v in given.floor.axes]
    y0, y1 = given.steps.y0.copy(), given.steps.y1.copy()
    for y, error in zip((y0, y1), _errors(given, fit), strict=True):
        y[:, unseen] -= error[:, unseen]
    return replace(given.steps, y0=y0, y1=y1)


def _errors(given: Problem, fit: Fit) -> tuple[Array, Array]:
    """(n, nx) at the start of each step, and at its end."""
    joined, f = given.steps.joined, given.jacobian(fit.model)
    whiten, z = fit.whiten, fit.z
    if given.bends:  # a fit is about where its own model has the states, and R is far too large for another F
        whiten = noises.Whitener(fit.noise, f, joined)
        z = whiten(given.residual(fit.model))
    s = whiten.back(z * noises.weight(z))
    none = np.zeros((1, s.shape[1]))
    back = np.einsum("kji,kj->ki", f, s)
    before = np.where(joined[:, None], np.concatenate([none, s[:-1]]), 0.0)
    behind = np.where(np.append(joined[1:], False)[:, None], np.concatenate([back[1:], none]), 0.0)
    return fit.noise.r * (before - back), fit.noise.r * (s - behind)


def uncertain(fit: Fit, f: Array) -> Array:
    """(nx,) variances of smoothed positions and speeds; of states that were measured, of their measurement. f: (n, nx, nx), F of the steps.

    With l = Q g^2 / R, g = dp'/dv (of a position: dt), the smoother averages over pi / l^(1/4) rows (the half-power frequency of a spline
    is l^(1/4) / 2 pi a row).
    """
    told = fit.noise.r.copy()
    for p, v in fit.noise.axes:
        g = max(float(np.sqrt(np.mean(f[:, p, v] ** 2))), 1e-300)
        corner = (fit.noise.q[v] * g * g / fit.noise.r[p]) ** 0.25
        told[p] = fit.noise.r[p] * min(1.0, corner / np.pi)
        told[v] = told[p] * (corner / g) ** 2 / 3.0
    return told


def measured(data: Dataset, error: Array) -> Array:
    """error (n, nx) or (nx,), with NaN for speeds that were not measured: no comparison with them holds."""
    if not data.axes_without_speed:
        return error
    told = error.copy()
    told[..., [v for _, v in data.axes_without_speed]] = np.nan
    return told
