"""Where rollouts begin that are to tell models apart, if the speed of an axis was not measured: where the axis was, by the model itself.

The whitened residual z of a model says what the errors of the measurements were, under that model and its noise: with s = S^-1 r = L^-T z,

    e_k = R (s_{k-1} - F_k' s_k),       y_k - e_k: position and speed, smoothed        (s_{k-1} = 0 where step k begins anew)

A speed that was smoothed under another model would take its side. Errors of such a speed are no errors of a measurement: models are
told apart by those of what was measured.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from s2r_runtime.trace import residual_noise as noises
from s2r_runtime.trace.dataset import Dataset
from s2r_runtime.trace.fitting import Fit, Problem

Array = NDArray[np.float64]


def begun(given: Problem, fit: Fit) -> Array | None:
    """(rows of the runs laid end to end, nx) smoothed under the model; None where every state was measured."""
    if not given.floor.axes:
        return None
    steps, model = given.steps, fit.model
    f = given.jacobian(model)
    s = fit.whiten.back(fit.z * noises.weight(fit.z))
    before = np.where(steps.joined[:, None], np.concatenate([np.zeros((1, s.shape[1])), s[:-1]]), 0.0)
    error = fit.noise.r * (before - np.einsum("kji,kj->ki", f, s))
    y = np.concatenate([run.y for run in given.data.runs])
    y[steps.place + steps.run] = steps.y0 - error
    return y


def uncertain(fit: Fit, dt: float) -> Array:
    """(nx,) variances of smoothed positions and speeds; of states that were measured, of their measurement.

    With l = Q dt^2 / R, the smoother averages over pi / l^(1/4) rows (the half-power frequency of a spline is l^(1/4) / 2 pi a row).
    """
    told = fit.noise.r.copy()
    for p, v in fit.noise.axes:
        corner = (fit.noise.q[v] * dt * dt / fit.noise.r[p]) ** 0.25
        told[p] = fit.noise.r[p] * min(1.0, corner / np.pi)
        told[v] = told[p] * (corner / dt) ** 2 / 3.0
    return told


def measured(data: Dataset, error: Array) -> Array:
    """error (n, nx) or (nx,), with NaN for speeds that were not measured: no comparison with them holds."""
    if not data.axes_without_speed:
        return error
    told = error.copy()
    told[..., [v for _, v in data.axes_without_speed]] = np.nan
    return told
