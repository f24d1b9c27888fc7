"""Outlying steps of a residual: what hits the process stays there, what a sensor gets wrong is back with the next right row."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from s2r_runtime.trace.estimation.innovation_outliers import are_shocks

Array = NDArray[np.float64]

N, FAR = 2000, np.array([5.0, 5.0])
F = np.array([[1.0, 0.3], [0.0, 0.9]])
AT = np.arange(50, 1950, 40)


def _residual(error: Array | None = None, hits: Array | None = None, f: Array = F) -> tuple[Array, Array, NDArray[np.bool_]]:
    """(r, F, joined) of a state that is measured with errors (N + 1, 2), white ones besides, and hit (N, 2)."""
    rng = np.random.default_rng(1)
    e = rng.normal(size=(N + 1, 2)) * 0.5 + (0.0 if error is None else error)
    r = (0.0 if hits is None else hits) + e[1:] - e[:-1] @ f.T
    return r, np.tile(f, (N, 1, 1)), np.append(False, np.ones(N - 1, dtype=bool))


def _put(rows: int, at: Array, *values: float) -> Array:
    """(rows, 2), of the second state: these values from each of `at` on."""
    put = np.zeros((rows, 2))
    for later, value in enumerate(values):
        put[at + later, 1] = value
    return put


@pytest.mark.parametrize("values", [(40.0,), (20.0, 20.0), (15.0, 15.0, 15.0), (40.0, -16.0), (40.0, -28.0)])
def test_hits_stay_also_if_a_part_of_them_rebounds(values: tuple[float, ...]) -> None:
    assert are_shocks(*_residual(hits=_put(N, AT, *values)), FAR)


@pytest.mark.parametrize("values", [(40.0,), (40.0, -30.0), (40.0, 25.0), (30.0, 60.0, -20.0)])
def test_measurements_that_are_off_are_none_for_some_rows_on_end_neither(values: tuple[float, ...]) -> None:
    """Each is seen in both states: in the first one, which the second one drives, a step later."""
    r, f, joined = _residual(_put(N + 1, AT, *values))
    assert np.count_nonzero(np.abs(r[:, 0]) > FAR[0]) >= len(AT)
    assert not are_shocks(r, f, joined, FAR)


def test_what_goes_on_is_no_shock() -> None:
    """An end stop pushes back for six steps."""
    assert not are_shocks(*_residual(hits=_put(N, AT, *[-30.0] * 6)), FAR)


@pytest.mark.parametrize(("hit", "wild", "shocks"), [(47, 0, True), (12, 35, False), (4, 0, False)])
def test_shocks_must_be_some_and_a_good_part(hit: int, wild: int, shocks: bool) -> None:
    """A row that is off makes two outlying steps."""
    error = _put(N + 1, AT[hit:][:wild], 40.0) if wild else None
    assert are_shocks(*_residual(error, _put(N, AT[:hit], 40.0)), FAR) == shocks


def test_where_a_run_ends_the_two_cannot_be_told_apart_and_another_run_says_nothing() -> None:
    """A hit in the first step of each run, and one the other way in the last one, which nobody saw staying."""
    r, f, joined = _residual(hits=_put(N, AT, -40.0, 40.0))
    joined[AT + 1] = False
    assert are_shocks(r, f, joined, FAR)
    last_only, f, joined = _residual(hits=_put(N, AT, 40.0))
    joined[AT + 1] = False
    assert not are_shocks(last_only, f, joined, FAR)


def test_where_a_state_is_set_anew_in_every_step_nobody_can_tell() -> None:
    assert not are_shocks(*_residual(hits=_put(N, AT, 40.0), f=np.zeros((2, 2))), FAR)


@pytest.mark.parametrize("wild", [0.1, 0.2])
def test_a_heading_that_is_off_for_a_row_is_none_although_the_way_bends_with_it(wild: float) -> None:
    """The place is known to a millimetre, and seems to be off by as much as the heading leads aside."""
    rng, v, dt, joined = np.random.default_rng(2), 1.0, 0.1, np.append(False, np.ones(N - 1, dtype=bool))
    y = rng.normal(size=(N + 1, 3)) * [1e-3, 1e-3, 2e-3]
    y[:, 0] += v * dt * np.arange(N + 1)
    y[AT, 2] += wild
    r = y[1:] - y[:-1] - v * dt * np.column_stack([np.cos(y[:-1, 2]), np.sin(y[:-1, 2]), np.zeros(N)])
    f = np.tile(np.eye(3), (N, 1, 1))
    f[:, 0, 2], f[:, 1, 2] = -v * dt * np.sin(y[:-1, 2]), v * dt * np.cos(y[:-1, 2])
    assert not are_shocks(r, f, joined, np.array([7e-3, 7e-3, 0.013]))
