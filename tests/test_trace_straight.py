"""Recordings slower than the loop that set their inputs: these moved on between the rows."""

from dataclasses import replace

import numpy as np
import pytest

from s2r_runtime.models.composed import compose
from s2r_runtime.modelspec import EffectSpec, ModelSpec
from s2r_runtime.plugins import registry
from s2r_runtime.recordings.transitions import Transitions
from s2r_runtime.trace.data import input_hold as inputs_straight
from s2r_runtime.trace.data.dataset import Stream, from_streams
from s2r_runtime.trace.data.input_hold import ROUNDS, samples_of, straight
from s2r_runtime.trace.data.input_interpolation import Samples, Way
from s2r_runtime.trace.estimation.parameters import Added
from s2r_runtime.trace.estimation.prediction import steps_of
from s2r_runtime.trace.estimation.problem import evaluate, fitted, problem
from s2r_runtime.trace.pipeline import load_dataset, trace

pytestmark = pytest.mark.slow

DT_S, TICKS, NOISE = 0.02, 10, 1e-3


def _joint(seed, friction, held, rows=1500):
    """A joint under a force of some sines, set TICKS times a row, or held for each row; as a table's streams."""
    model, rng = compose(ModelSpec("joint", DT_S)), np.random.default_rng(seed)
    f, phase = rng.uniform(0.2, 1.5, 5)[:, None], rng.uniform(0.0, 6.3, 5)[:, None]
    t = np.arange(rows * TICKS) * DT_S / TICKS
    force = np.sum(np.cos(2.0 * np.pi * f * t + phase), axis=0)
    force = np.repeat(force[::TICKS], TICKS) if held else force
    q, v, h, states = 0.0, 0.0, DT_S / TICKS, []
    for k, u in enumerate(force.tolist()):
        if k % TICKS == 0:
            states.append((q, v))
        a = u - friction * v
        q, v = q + h * v + 0.5 * h * h * a, v + h * a
    stamps = t[::TICKS]
    measured = np.array(states) + rng.normal(size=(rows, 2)) * NOISE
    return model, from_streams(model, [(Stream(stamps, measured), Stream(stamps, force[::TICKS, None]))], "a table")


def test_a_force_that_moves_on_between_the_rows_is_no_structure():
    model, data = _joint(1, friction=0.0, held=False)
    result = trace(data, model)
    assert result.verdict == "none"
    assert result.way.most == pytest.approx(1.0 - 1.0 / TICKS, abs=0.03)
    assert result.to_json()["inputs_moved_on"] == pytest.approx(0.5 - 0.5 / TICKS, abs=0.015)
    assert "went on changing between the rows" in result.text()


def test_friction_beside_a_force_that_moves_on_has_its_size():
    model, data = _joint(2, friction=0.3, held=False)
    (found,) = trace(data, model).effects
    assert (found.name, found.channel) == ("viscous_friction", "qd")
    _, low, high, _ = found.parameters["coefficient"]
    assert low < 0.3 < high


def _late(seed, delay, rows=1200):
    """A joint under a force that goes straight from one value to another in a tenth of a second, held for each row, and comes late."""
    model, rng = compose(ModelSpec("joint", DT_S)), np.random.default_rng(seed)
    t = DT_S * np.arange(rows)
    corners = np.arange(0.0, t[-1] + 0.2, 0.1)
    force = np.interp(t, corners, np.convolve(rng.uniform(-1.0, 1.0, len(corners)), np.ones(6) / 6.0, "same"))
    whole, part = divmod(delay / DT_S, 1)
    before, after = (np.concatenate([np.zeros(k), force[: rows - k]]) for k in (int(whole) + 1, int(whole)))
    q, v, states = 0.0, 0.0, []
    for pair in zip(before.tolist(), after.tolist(), strict=True):
        states.append((q, v))
        for a, h in zip(pair, (part * DT_S, (1.0 - part) * DT_S), strict=True):
            q, v = q + h * v + 0.5 * h * h * a, v + h * a
    measured = np.array(states) + rng.normal(size=(rows, 2)) * NOISE
    return model, from_streams(model, [(Stream(t, measured), Stream(t, force[:, None]))], "a table")


@pytest.mark.parametrize("seed", [4, 5])
def test_a_delay_of_a_smooth_force_that_is_held_is_not_half_a_row_longer(seed):
    """Halfway to the next row, and half a row later, is nearly the same: what the delay makes up for is no gain of such a way."""
    model, data = _late(seed, delay=0.812)
    result = trace(data, model)
    assert result.way == Way()
    (found,) = result.effects
    assert (found.name, found.channel) == ("input_delay", "force")
    _, low, high, _ = found.parameters["delay"]
    assert low < 0.812 < high


@pytest.mark.parametrize("friction", [0.0, 0.3])
def test_a_force_that_is_held_is_taken_as_held(friction):
    model, data = _joint(3, friction, held=True)
    result = trace(data, model)
    assert not result.way
    assert [e.name for e in result.effects] == ["viscous_friction"] * (friction > 0.0)


def test_runs_of_which_some_began_under_way_tell_it_too():
    """Which of them did is another question with each way that inputs may have gone."""
    model, data = _joint(1, friction=0.3, held=False)
    ((states, inputs),) = data.segments
    rows = [slice(k, k + 170) for k in range(0, 1440, 180)]
    runs = [tuple(Stream(one.t[some] - one.t[some.start], one.values[some]) for one in (states, inputs)) for some in rows]
    assert trace(from_streams(model, runs, "runs"), model).way.most == pytest.approx(1.0 - 1.0 / TICKS, abs=0.03)


@pytest.mark.parametrize("held", [True, False])
def test_a_recording_without_a_state_that_the_motion_does_not_need_is_laid_without_it(tmp_path, held):
    """A car whose speed nobody measured, steered by a wheel that moves on, or commanded anew every row."""
    model, fine, rng = compose(ModelSpec("bicycle", 0.05)), compose(ModelSpec("bicycle", 0.05 / TICKS)), np.random.default_rng(5)
    t = np.arange(600 * TICKS) * 0.05 / TICKS
    u = np.column_stack([0.2 * np.sin(2.3 * t) + 0.1 * np.cos(4.1 * t), np.full(len(t), 0.8)])
    u = np.repeat(u[::TICKS], TICKS, axis=0) if held else u
    x, hidden, rows = np.zeros((1, 4)), fine.at_rest(1), []
    for k in range(len(t)):
        if k % TICKS == 0:
            rows.append([t[k], *(x[0, :3] + NOISE * rng.normal(size=3)), *u[k]])
        x, hidden = fine.step(x, u[k : k + 1], hidden)
    path = tmp_path / "car.csv"
    np.savetxt(path, rows, delimiter=",", header="t,x,y,theta,steer_cmd,speed_cmd", comments="")
    data = load_dataset(path, model)
    result = trace(data, model, test=data)
    assert result.unseen == ("speed",)
    assert result.way.most == pytest.approx(0.0 if held else 1.0 - 1.0 / TICKS, abs=0.1)


def test_samples_of_a_campaign_stay_with_inputs_that_moved_on():
    model, data = _joint(4, friction=0.0, held=False, rows=50)
    samples = Transitions(np.zeros((2, 2)), np.zeros((2, 1)), np.zeros((2, 2)), None, 1, True, {}, "", np.zeros(2), "here")
    assert straight(replace(data, campaign=samples), model, Way((0.5,), (0.0,)), samples_of(data)).campaign is samples


@pytest.mark.parametrize(("after", "told"), [(-0.05, 0.8), (-0.9, 0.0)])
def test_what_is_hardly_on_its_way_when_numbers_are_fitted_again_is_held(monkeypatch, after, told):
    model, data = _joint(6, friction=0.0, held=False, rows=100)
    given = problem(data, steps_of(data))
    says = iter([([after], 0.0), *[([min(after + 0.05, 0.0)], 0.0)] * ROUNDS])
    monkeypatch.setattr(inputs_straight, "_betas", lambda *asked: next(says))
    way = inputs_straight._settled(lambda way: given, evaluate(given, model), Way((0.85,), (0.0,)))
    assert way.most == pytest.approx(told)


@pytest.mark.parametrize("held", [True, False])
def test_friction_that_half_a_row_looks_like_gives_way_to_inputs_that_moved_on(held):
    """On a sine of rate w, a force that is late by s seconds is friction of mass w^2 s; on some sines nearly so."""
    model, data = _joint(7, friction=0.1 if held else 0.0, held=held)
    given, samples = problem(data, steps_of(data)), samples_of(data)
    friction = Added(registry().get("effects", "viscous_friction"), "qd", {"coefficient": 0.05})
    rubs = replace(model, effects=(friction,))
    fit = fitted(given, evaluate(given, rubs), rubs)
    assert fit.model.effects[0].p["coefficient"] > 0.01
    way = inputs_straight._instead(lambda way: replace(given, data=straight(data, model, way, samples)), fit, np.array([True]))
    assert way is None if held else way.on == (pytest.approx(1.0 - 1.0 / TICKS, abs=0.05),)


def test_noise_of_forces_is_told_before_a_filter_makes_it_smooth(tmp_path):
    """Of an encoder's positions, steps are longer than rows: all passes through one low-pass, and so does the forces' noise."""
    h, ticks, rng = 1e-3, 4, np.random.default_rng(2)
    t = np.arange(8000) * h
    f, phase = np.array([[0.3], [0.7], [0.9], [2.3]]), rng.uniform(0.0, 6.3, (4, 1))
    force = 1.2 * np.sum([[0.6], [0.4], [0.3], [0.06]] * (2.0 * np.pi * f) ** 2 * np.cos(2.0 * np.pi * f * t + phase), axis=0)
    v = np.concatenate([[0.0], np.cumsum(force / 1.2 * h)])[:-1]
    v -= v.mean()
    q = np.concatenate([[0.0], np.cumsum(v * h + 0.5 * h * h * force / 1.2)])[:-1]
    step = 2.0 * np.pi / 2**17
    table = np.column_stack([t, np.round(q / step) * step, force + 0.4 * rng.normal(size=len(t))])[::ticks]
    np.savetxt(tmp_path / "joint.csv", table, delimiter=",", header="t,q,force", comments="")
    model = compose(ModelSpec("joint", ticks * h, {"mass": 1.2}))
    result = trace(load_dataset(tmp_path / "joint.csv", model), model)
    assert result.verdict == "none"
    assert result.way.most == pytest.approx(1.0 - 1.0 / ticks, abs=0.1)
    assert result.noisy["force"] > 0.1


def _unicycle(seed, noise=(0.0, 0.0), late=False, held=(), pose=(1e-3, 2e-3)):
    """A robot on arcs whose speeds, `noise` m/s and rad/s, somebody measured at the rows, or over the row before; 50 parts a row."""
    parts, rows, rng = 50, 900, np.random.default_rng(seed)
    model = compose(ModelSpec("unicycle", 0.05, {}, (EffectSpec("integration_scheme", "*", {"scheme": "exact"}),)))
    h = 0.05 / parts
    t = np.arange(rows * parts) * h
    f, phase = rng.uniform(0.1, 0.9, (4, 2)), rng.uniform(0.0, 6.3, (4, 2))
    u = 0.25 * np.sum(np.cos(2.0 * np.pi * f[:, None] * t[None, :, None] + phase[:, None]), axis=0) * [0.8, 1.6]
    for j in held:
        u[:, j] = np.repeat(u[::parts, j], parts)
    turned = np.cumsum(u[:, 1] * h)
    middle = turned - 0.5 * u[:, 1] * h
    x = np.column_stack([np.cumsum(u[:, 0] * h * np.cos(middle)), np.cumsum(u[:, 0] * h * np.sin(middle)), turned])
    x = np.concatenate([np.zeros((1, 3)), x])[:-1:parts]
    told = u[::parts] + rng.normal(size=(rows, 2)) * noise
    if late:
        told = np.concatenate([told[:1], u.reshape(rows, parts, 2).mean(axis=1)[:-1]])
    states = Stream(t[::parts], x + rng.normal(size=x.shape) * [pose[0], *pose])
    return model, from_streams(model, [(states, Stream(t[::parts], told))], "a table")


def test_noise_of_the_sensors_that_told_the_inputs_is_no_structure():
    model, data = _unicycle(1, noise=(0.03, 0.06))
    result = trace(data, model)
    assert result.verdict == "none"
    assert result.noisy == pytest.approx({"v": 0.03, "w": 0.06}, rel=0.15)
    assert result.to_json()["inputs_noise"] == result.noisy
    assert "noise was taken out of them" in result.text()


def test_speeds_that_were_counted_over_the_row_before_are_taken_from_the_next_row():
    model, data = _unicycle(2, late=True, pose=(4e-3, 8e-3))
    result = trace(data, model)
    assert result.verdict == "none"
    assert result.to_json()["inputs_late"]
    assert "a row late" in result.text()


def test_an_input_that_is_held_beside_one_that_moves_on_stays_where_it_is():
    model, data = _unicycle(3, held=(1,))
    result = trace(data, model)
    assert result.verdict == "none"
    assert result.way.on == (pytest.approx(1.0, abs=0.05), 0.0)
    assert "some inputs" in result.text()


def test_what_an_input_that_moves_on_leaves_is_no_memory_although_it_shows_only_just():
    """By some 20 nats, less than two inputs, each on a way of its own, are asked for at first."""
    model, data = _unicycle(3, held=(1,), pose=(0.012, 0.024))
    result = trace(data, model)
    assert (result.verdict, result.depends_on) == ("none", ())
    assert result.way.on == (pytest.approx(1.0, abs=0.1), 0.0)


def test_commands_that_jump_in_every_row_are_not_smoothed():
    rng = np.random.default_rng(4)
    model = compose(ModelSpec("unicycle", 0.05))
    u = rng.normal(size=(900, 2)) * [0.3, 0.6]
    x, rows = np.zeros((1, 3)), []
    for k in range(900):
        rows.append(x[0] + rng.normal(size=3) * [1e-3, 1e-3, 2e-3])
        x = model.nominal.step(x, u[k : k + 1], 0.05, {})
    t = 0.05 * np.arange(900)
    result = trace(from_streams(model, [(Stream(t, np.array(rows)), Stream(t, u))], "a table"), model)
    assert (result.verdict, bool(result.way)) == ("none", False)


def _tank(seed, at_rows, lag=0.0, rows=1200, lags=1, noise=2e-3, hold_s=(15.0, 60.0)):
    """A tank's level under a pump that is set anew now and then, between the rows (1 s) or on them; through so many lags, s."""
    parts, rng = 20, np.random.default_rng(seed)
    u, k = np.zeros(rows * parts), 0
    while k < len(u):
        hold = round(rng.uniform(*hold_s)) * parts + (0 if at_rows else int(rng.integers(parts)))
        u[k : k + hold] = rng.uniform(0.2, 1.8)
        k += hold
    level, chain, levels = 1.0, [u[0]] * lags, []
    for k, asked in enumerate(u.tolist()):
        if k % parts == 0:
            levels.append(level)
        for i in range(lags):
            chain[i] += (asked - chain[i]) * (1.0 - np.exp(-1.0 / parts / lag)) if lag else asked - chain[i]
            asked = chain[i]
        level += (0.05 * asked - 0.05 * level) / parts
    t = np.arange(rows, dtype=float)
    measured = np.array(levels)[:, None] + noise * rng.normal(size=(rows, 1))
    return [(Stream(t, measured), Stream(t, u[::parts, None]))]


TANK = """
STATES = ("level",)
INPUTS = ("pump",)
PARAMS = {"rate": 0.05}


def step(x, u, dt, params):
    for _ in range(10):
        x = x + dt / 10 * params["rate"] * (u - x)
    return x
"""


@pytest.mark.parametrize("at_rows", [True, False])
def test_commands_that_change_between_the_rows_are_no_structure(tmp_path, at_rows):
    (tmp_path / "tank.py").write_text(TANK)
    model = compose(ModelSpec(str(tmp_path / "tank.py"), 1.0))
    result = trace(from_streams(model, _tank(1, at_rows), "a table"), model)
    assert result.verdict == "none"
    assert result.to_json()["inputs_changed_within"] is not at_rows
    assert ("changed between the rows" in result.text()) is not at_rows


def test_a_lag_of_commands_that_change_between_the_rows_has_its_size(tmp_path):
    (tmp_path / "tank.py").write_text(TANK)
    model = compose(ModelSpec(str(tmp_path / "tank.py"), 1.0))
    result = trace(from_streams(model, _tank(2, at_rows=False, lag=6.0), "a table"), model)
    (found,) = result.effects
    assert (found.name, found.channel) == ("input_lag", "pump")
    assert found.values["time_constant"] == pytest.approx(6.0, rel=0.07)
    assert result.depends_on == ()


def test_what_remembers_in_another_way_is_no_clock_of_the_commands(tmp_path):
    """Two lags look like one, and a delay, with all commands half a row too early: they would all have come at the same part of a row."""
    (tmp_path / "tank.py").write_text(TANK)
    model = compose(ModelSpec(str(tmp_path / "tank.py"), 1.0))
    result = trace(from_streams(model, _tank(1, at_rows=True, lag=1.5, lags=2, noise=1e-3, hold_s=(8.0, 30.0)), "a table"), model)
    assert not result.to_json()["inputs_changed_within"]
    delays = [found.values["delay"] for found in result.effects if found.name == "input_delay"]
    assert all(delay == pytest.approx(0.8, abs=0.1) for delay in delays)


def test_a_test_recording_whose_force_is_held_is_judged_as_held():
    model, samples = _joint(1, friction=0.0, held=False)
    rng = np.random.default_rng(2)
    force = np.repeat(rng.uniform(-3.0, 3.0, 100), 10)
    q, v, states = 0.0, 0.0, []
    for u in force.tolist():
        states.append((q, v))
        q, v = q + DT_S * v + 0.5 * DT_S**2 * u, v + DT_S * u
    stamps = DT_S * np.arange(len(force))
    measured = np.array(states) + rng.normal(size=(len(force), 2)) * NOISE
    commands = from_streams(model, [(Stream(stamps, measured), Stream(stamps, force[:, None]))], "another table")
    result = trace(samples, model, test=commands)
    error = result.to_json()["error"]
    assert result.way.most > 0.8
    assert all(error["before"]["rollout_rms"][s] < 1.3 * error["rollout_noise_floor"][s] for s in ("q", "qd"))


def test_only_inputs_that_were_placed_change_within_the_rows_of_another_recording():
    t = np.arange(12.0)
    values = np.column_stack([np.repeat([0.0, 1.0, 2.0], 4), np.repeat([5.0, 6.0, 7.0], 4)])
    placed, others = (Samples([Stream(t, values)]) for _ in range(2))
    placed.within = [placed.within[0] * [0.7, 0.0]]
    assert np.array_equal(others.as_of(placed).within[0] > 0.0, (np.diff(values, axis=0, append=values[-1:]) != 0.0) & [True, False])


@pytest.mark.parametrize("way", [Way((1.0,), (0.0,)), Way((0.0,), (1.0,)), Way(late=True)])
def test_steps_stay_in_as_many_parts_however_inputs_went(way):
    model, steps = compose(ModelSpec("joint", DT_S)), np.arange(400)
    between = steps[21::42] + 0.5  # rows beside the grid, as where stamps wander: commands that come there need steps in parts
    t = DT_S * np.sort(np.concatenate([steps, between]))
    force = np.cumsum(np.isin(np.rint(t / DT_S * 2.0) / 2.0, np.concatenate([between, steps[::3]])))[:, None] % 7.0
    data = from_streams(model, [(Stream(t, np.zeros((len(t), 2))), Stream(t, force))], "a table")
    moved = straight(data, model, way, samples_of(data))
    assert data.substeps > 1
    assert moved.substeps == data.substeps
    assert [run.u.shape for run in inputs_straight.acted(data, moved).runs] == [run.u.shape for run in data.runs]


def test_an_input_on_its_way_stays_within_what_was_asked():
    t = np.arange(40.0)
    valve = np.clip(1.5 * np.sin(0.9 * t), 0.0, 1.0)
    (laid,) = Samples([Stream(t, valve[:, None])]).laid(Way((0.9,), (0.0,)))
    assert laid.values.min() >= 0.0
    assert laid.values.max() <= 1.0
