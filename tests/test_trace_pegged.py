"""A sensor at the end of its range repeats one value exactly, while what is measured goes on. Other things repeat, too."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray
from seeds import first

from s2r_runtime.models.composed import ComposedModel, compose
from s2r_runtime.modelspec import EffectSpec, ModelSpec
from s2r_runtime.trace.data.dataset import Dataset, from_arrays
from s2r_runtime.trace.pipeline import trace
from s2r_runtime.trace.sensor_faults.detect import check

Array = NDArray[np.float64]

ROWS, DT = 1000, 0.02
TANK = """import numpy as np

STATES = ("level",)
INPUTS = ("pump",)
PARAMS = {"fills": 0.5, "drains": 0.6}


def step(x, u, dt, params):
    return x + dt * (params["fills"] * u - params["drains"] * np.sqrt(np.maximum(x, 0.0)))
"""
JOINT = compose(ModelSpec("joint", DT, {"mass": 2.0}))
MOTOR = compose(ModelSpec("joint", DT, {"mass": 0.02}, (EffectSpec("viscous_friction", "qd", {"coefficient": 0.1}),)))


def _pumped(folder, seed: int, brim: float = np.inf, fills: float = 0.5) -> tuple[ComposedModel, Array, Array]:
    """(model, levels, commands) of a tank that is full at a brim; it fills and drains over a minute, in steps of 0.5 s."""
    (folder / "tank.py").write_text(TANK)
    model = compose(ModelSpec(str(folder / "tank.py"), 0.5))
    rng = np.random.default_rng(seed)
    u = np.repeat(rng.uniform(0.5, 3.5, ROWS // 20), 20) + 0.1 * rng.normal(size=ROWS)
    x, rows = np.array([[4.0]]), [4.0]
    for k in range(ROWS):
        x = np.minimum(model.nominal.step(x, u[k : k + 1, None], 0.5, {**model.parameters, "fills": fills}), brim)
        rows.append(float(x[0, 0]))
    return model, np.array(rows)[:, None], u[:, None]


def _driven(model: ComposedModel, seed: int, stop: float = np.inf) -> tuple[Array, Array]:
    """(states, forces) of a joint with a stop on one side."""
    rng = np.random.default_rng(seed)
    u, x, rows = np.zeros((ROWS, 1)), np.zeros((1, 2)), [np.zeros(2)]
    for k in range(ROWS):
        u[k] = 6.0 * np.sin(0.02 * k) + 0.8 * rng.normal() - 4.0 * x[0, 0] - 2.0 * x[0, 1]
        x, _ = model.step(x, u[k][None], model.at_rest(1))
        if x[0, 0] > stop:
            x = np.array([[stop, 0.0]])
        rows.append(x[0])
    return np.array(rows), u


def _frozen(data: Dataset, model: ComposedModel) -> list[str]:
    return [fault.channel for fault in trace(data, model).faults if fault.kind == "frozen"]


@pytest.mark.parametrize("seed", first(2, range(6)))
def test_a_level_beyond_the_range_of_its_sensor_is_a_fault_and_the_pump_is_still_named(tmp_path, seed):
    """It goes on filling, and says so when it comes back into range."""
    model, levels, u = _pumped(tmp_path, seed, fills=0.6)
    end = float(np.quantile(levels, 0.8))
    y = np.minimum(np.round(levels + 0.02 * np.random.default_rng(9 + seed).normal(size=levels.shape), 4), round(end, 4))
    found = trace(from_arrays(model, [(y, u)]), model)
    assert {(fault.kind, fault.channel) for fault in found.faults} == {("frozen", "level")}
    assert {e.name for e in (*found.effects, *found.ambiguous_with)} & {"input_gain", "parameter_change"}


@pytest.mark.slow
@pytest.mark.parametrize("seed", first(1, range(6)))
def test_a_tank_that_is_full_under_a_sensor_that_goes_farther_is_none(tmp_path, seed):
    """The sensor's noise goes on."""
    model, levels, u = _pumped(tmp_path, seed, brim=5.0)
    assert np.count_nonzero(levels == 5.0) > 50
    y = np.round(levels + 0.02 * np.random.default_rng(9 + seed).normal(size=levels.shape), 4)
    assert _frozen(from_arrays(model, [(y, u)]), model) == []


@pytest.mark.slow
@pytest.mark.parametrize("seed", first(1, range(6)))
def test_an_end_of_range_of_an_angle_is_told_and_an_end_stop_is_not(seed):
    rng = np.random.default_rng(9 + seed)
    y, u = _driven(JOINT, seed)
    noise = rng.normal(size=y.shape) * [2e-3, 1e-2]
    end = float(np.quantile(y[:, 0], 0.85))
    pegged = y + noise
    pegged[:, 0] = np.minimum(pegged[:, 0], end)
    assert {*_frozen(from_arrays(JOINT, [(pegged, u)]), JOINT)} == {"q"}
    stopped, u = _driven(JOINT, seed, stop=end)
    for seen in (stopped + noise, np.round(stopped, 4), np.round(stopped, 2)):  # a noisy sensor, and encoders
        assert _frozen(from_arrays(JOINT, [(seen, u)]), JOINT) == []


@pytest.mark.parametrize("seed", first(1, range(6)))
def test_a_motor_at_its_limit_that_is_read_without_noise_is_none(seed):
    """All the jitter of its speed is that of the commands, and at its limit it has none."""
    y, u = _driven(MOTOR, seed)
    speed = np.quantile(y[:, 1], 0.8)
    y[:, 1] = np.minimum(y[:, 1], speed)
    assert "qd" not in _frozen(from_arrays(MOTOR, [(np.round(y, 4), u)]), MOTOR)


@pytest.mark.parametrize("seed", first(1, range(6)))
def test_a_full_tank_of_which_nothing_is_known_but_a_level_without_noise_costs_no_name(tmp_path, seed):
    """What flows in wavers, and at the brim nothing does: that looks like the end of a range. The pump is still what it is."""
    model, _, u = _pumped(tmp_path, seed)
    rng, x, rows = np.random.default_rng(9 + seed), np.array([[4.0]]), [4.0]
    for k in range(ROWS):
        x = np.minimum(model.nominal.step(x, u[k : k + 1], 0.5, {**model.parameters, "fills": 0.6}) + 0.02 * rng.normal(), 5.0)
        rows.append(float(x[0, 0]))
    y = np.array(rows)[:, None]
    assert np.count_nonzero(y == 5.0) > 50
    found = trace(from_arrays(model, [(np.round(y, 5), u)]), model)
    assert {e.name for e in (*found.effects, *found.ambiguous_with)} & {"input_gain", "parameter_change"}


@pytest.mark.parametrize("seed", first(2, range(6)))
def test_a_robot_that_is_parked_where_it_never_went_beyond_is_none(seed):
    """A localiser that is noisy on the way, and holds its last pose where the robot rests."""
    model = compose(ModelSpec("unicycle", 0.05, {}, (EffectSpec("integration_scheme", "*", {"scheme": "exact"}),)))
    rng, goes = np.random.default_rng(seed), (np.arange(900) % 300) < 220
    u = np.column_stack([np.repeat(rng.uniform(low, high, 30), 30) for low, high in ((0.2, 0.8), (-0.8, 0.8))]) * goes[:, None]
    x, rows = np.zeros((1, 3)), [np.zeros(3)]
    for k in range(900):
        x, _ = model.step(x, u[k][None], model.at_rest(1))
        rows.append(x[0])
    y = np.array(rows) + 5e-3 * rng.normal(size=(901, 3))
    for k in np.flatnonzero(~goes):
        y[k + 1] = y[k]
    assert _frozen(from_arrays(model, [(y, u)]), model) == []


@pytest.mark.parametrize("seed", first(2, range(12)))
def test_beside_single_rows_at_the_end_of_range_another_sensor_is_right(seed):
    """A speed that is rounded repeats now and then by chance, also where the angle is at its end for a row."""
    rng = np.random.default_rng(seed)
    x, rows, u = np.zeros((1, 2)), [np.zeros(2)], np.zeros((2000, 1))
    for k in range(2000):
        u[k] = 6.0 * np.sin(0.005 * k) + 0.8 * rng.normal() - 4.0 * x[0, 0] - 2.0 * x[0, 1]
        x, _ = JOINT.step(x, u[k][None], JOINT.at_rest(1))
        rows.append(x[0])
    y = np.array(rows) + rng.normal(size=(2001, 2)) * [0.3, 1e-2]
    y[:, 1] = np.round(y[:, 1] / 3e-4) * 3e-4
    y[:, 0] = np.minimum(y[:, 0], np.quantile(y[:, 0], 0.8))
    assert {fault.channel for fault in check(JOINT, from_arrays(JOINT, [(y, u)])).faults} <= {"q"}
