"""An axis whose position alone was measured: its speed is told from that, and models are judged on the position, whatever the speed was."""

from dataclasses import replace

import numpy as np
import pytest
from trace_robots import PARTS, acted, commands

from s2r_runtime.models.composed import compose
from s2r_runtime.modelspec import EffectSpec, ModelSpec
from s2r_runtime.trace.data.dataset import thinned
from s2r_runtime.trace.data.missing_rows import BRIEF, bridged
from s2r_runtime.trace.data.readers import load_dataset
from s2r_runtime.trace.estimation.initial_states import begun
from s2r_runtime.trace.estimation.prediction import steps_of
from s2r_runtime.trace.estimation.problem import evaluate, problem
from s2r_runtime.trace.estimation.speed_spline import smoothed
from s2r_runtime.trace.pipeline import trace

MASS = 2.0

PUSHES = {
    "coulomb_friction": lambda q, v, p: (0.0, p["force"]),
    "stribeck_friction": lambda q, v, p: (0.0, p["force"] + (p["static_force"] - p["force"]) * np.exp(-((v / p["velocity"]) ** 2))),
    "viscous_friction": lambda q, v, p: (-p["coefficient"] * v, 0.0),
    "cubic_stiffness": lambda q, v, p: (-p["coefficient"] * q**3, 0.0),
}


def drive(u, effects, dt):
    """u (steps, 1) -> (steps + 1, 2), in parts of a step; dry friction stops the joint and never turns it."""
    part = dt / PARTS
    late = [e for e in effects if e[0] not in {*PUSHES, "input_rate_limit", "periodic_disturbance"}]
    force = acted(np.repeat(u[None], PARTS, axis=1), late, ("force",), part)[0, :, 0]
    for name, _, p in effects:
        if name == "periodic_disturbance":
            force += p["amplitude"] * np.sin(2.0 * np.pi * p["frequency"] * part * (np.arange(len(force)) + 0.5) + p["phase"])
        if name == "input_rate_limit":
            now = 0.0
            for k, wanted in enumerate(force.tolist()):
                force[k] = now = now + float(np.clip(wanted - now, -p["rate"] * part, p["rate"] * part))
    pushes = [(PUSHES[name], p) for name, _, p in effects if name in PUSHES]
    q, v, y = 0.0, 0.0, [(0.0, 0.0)]
    for k, pull in enumerate(force.tolist()):
        forces = [push(q, v, p) for push, p in pushes]
        free = v + part / MASS * (pull + sum(f for f, _ in forces))
        after = float(np.sign(free)) * max(abs(free) - part / MASS * sum(dry for _, dry in forces), 0.0)
        q, v = q + 0.5 * part * (v + after), after
        if (k + 1) % PARTS == 0:
            y.append((q, v))
    return np.array(y)


def _joint(dt, effects=()):
    return compose(ModelSpec("joint", dt, {"mass": MASS}, tuple(EffectSpec(*e) for e in effects)))


def _reversing(rng, steps, dt):
    """(steps, 1): a force that takes the joint away and back again."""
    u = commands(rng, 1, steps, dt, [(-3.0, 3.0)], hold=(0.1, 0.5))[0]
    half = max(2, round(0.6 / dt))
    for k in range(half, steps, 2 * half):
        u[k : k + half] = -u[k - half : k][: len(u[k : k + half])]
    return u


def _recorded(tmp_path, seed, effects=(), *, dt=0.01, steps=1500, noise=1e-4, keep=None, wild=()):
    """(model, path, y, noise that was added): a joint that is driven back and forth, its position in a file."""
    rng = np.random.default_rng(seed)
    u = _reversing(rng, steps, dt)
    y = drive(u, effects, dt)
    seen = y[:, 0] + noise * rng.normal(size=len(y))
    seen[list(wild)] += 100.0 * noise
    rows = [k for k in range(steps) if keep is None or keep(k)]
    path = tmp_path / "run.csv"
    path.write_text("\n".join(["t,q,force", *(f"{k * dt:.9g},{seen[k]:.9g},{u[k, 0]:.9g}" for k in rows)]) + "\n")
    return _joint(dt), path, y


@pytest.mark.parametrize(("dt", "noise"), [(0.002, 1e-5), (0.01, 1e-4), (0.03, 1e-3)])
def test_a_speed_is_told_from_positions_and_so_is_its_error(dt, noise):
    rng = np.random.default_rng(1)
    u = _reversing(rng, 2000, dt)
    y = drive(u, (("coulomb_friction", "qd", {"force": 0.8}),), dt)
    found = smoothed(dt * np.arange(2000), y[:2000, 0] + noise * rng.normal(size=2000), u[:1999, 0] / MASS)
    error = float(np.std(found.speed - y[:2000, 1]))
    assert error < 0.1 * float(np.std(y[:, 1]))
    assert 0.5 * error < found.error < 2.0 * error


def test_outlying_positions_do_not_bend_the_speed():
    rng = np.random.default_rng(2)
    t = 0.01 * np.arange(1500)
    y = np.sin(t) + 1e-4 * rng.normal(size=1500)
    y[50::50] += 0.05
    assert np.max(np.abs(smoothed(t, y, np.zeros(1499)).speed - np.cos(t))[20:-20]) < 0.02


def test_what_a_model_explains_does_not_depend_on_the_speed_that_it_is_stepped_from(tmp_path):
    """The joint is linear: its likelihood is one of positions alone."""
    model, path, _ = _recorded(tmp_path, 3)
    data = load_dataset(path, model)
    wave = 0.05 * np.sin(0.01 * np.arange(len(data.runs[0].y)))
    other = replace(data, runs=(replace(data.runs[0], y=data.runs[0].y + np.outer(wave, [0.0, 1.0])),))
    first, second = (problem(d, steps_of(d)) for d in (data, other))
    second = replace(second, floor=first.floor)
    fits = [evaluate(given, model) for given in (first, second)]
    assert fits[1].white == pytest.approx(fits[0].white, abs=1.0)
    assert np.allclose(fits[0].z[5:, 0], fits[1].z[5:, 0], atol=0.02)


def test_noise_of_the_position_and_of_what_pushes_are_told_apart(tmp_path):
    rng = np.random.default_rng(4)
    dt, push, noise = 0.01, 0.02, 3e-4
    u = commands(rng, 1, 1400, dt, [(-3.0, 3.0)])[0]
    q, v, rows = 0.0, 0.0, ["t,q,force"]
    for k, (force,) in enumerate(u):
        rows.append(f"{k * dt:.9g},{q + noise * rng.normal():.9g},{force:.9g}")
        q, v = q + dt * v + 0.5 * dt * dt * force / MASS, v + dt * force / MASS + push * rng.normal()
    path = tmp_path / "run.csv"
    path.write_text("\n".join(rows) + "\n")
    model = _joint(dt)
    data = load_dataset(path, model)
    found = evaluate(problem(data, steps_of(data)), model).noise
    assert np.sqrt(found.q[1]) == pytest.approx(push, rel=0.25)
    assert np.sqrt(found.r[0]) == pytest.approx(noise, rel=0.1)


def test_rollouts_begin_where_the_model_itself_says_that_the_axis_was(tmp_path):
    effects = (("viscous_friction", "qd", {"coefficient": 2.0}),)
    _, path, y = _recorded(tmp_path, 5, effects)
    model = _joint(0.01, effects)
    data = load_dataset(path, model)
    given = problem(data, steps_of(data))
    states = begun(given, evaluate(given, model))
    rows = given.steps.place + given.steps.run
    inner = rows[50:-50]
    assert np.std(states[inner, 1] - y[inner, 1]) < 0.5 * np.std(data.runs[0].y[inner, 1] - y[inner, 1])


@pytest.mark.parametrize(
    ("effect", "channel", "values"),
    [
        ("coulomb_friction", "qd", {"force": 0.7}),
        ("viscous_friction", "qd", {"coefficient": 1.5}),
        pytest.param("stribeck_friction", "qd", {"force": 0.4, "static_force": 1.2, "velocity": 0.15}, marks=pytest.mark.slow),
        pytest.param("input_rate_limit", "force", {"rate": 20.0}, marks=pytest.mark.slow),
        ("input_lag", "force", {"time_constant": 0.05}),
        ("input_delay", "force", {"delay": 0.04}),
        ("input_gain", "force", {"gain": 0.85}),
        ("periodic_disturbance", "force", {"frequency": 2.2, "amplitude": 0.4, "phase": 0.7}),
        ("cubic_stiffness", "q", {"coefficient": 0.2}),
    ],
)
def test_an_effect_is_named_without_the_speed(tmp_path, effect, channel, values):
    model, path, _ = _recorded(tmp_path, 6, ((effect, channel, values),))
    found = trace(load_dataset(path, model), model)
    assert found.verdict == "traced"
    assert [(e.name, e.channel) for e in found.effects] == [(effect, channel)]
    for name, value in values.items():
        assert found.effects[0].parameters[name][0] == pytest.approx(value, rel=0.25, abs=0.1 if name == "phase" else None)


def test_a_second_of_a_fast_recording_is_enough_for_what_is_large(tmp_path):
    """Within the band of its motion, there were too few independent steps to say anything."""
    model, path, _ = _recorded(tmp_path, 7, (("input_gain", "force", {"gain": 0.6}),), dt=0.002, steps=1000, noise=2e-5)
    found = trace(load_dataset(path, model), model)
    assert [(e.name, e.channel) for e in found.effects] == [("input_gain", "force")]
    assert found.effects[0].parameters["gain"][0] == pytest.approx(0.6, rel=0.05)


def test_a_first_command_is_not_taken_to_have_been_there_before(tmp_path):
    """The speed was made with the inputs, so it says nothing of when they began to act."""
    model, path, _ = _recorded(tmp_path, 8, (("input_rate_limit", "force", {"rate": 8.0}),), dt=0.005, steps=600)
    found = trace(load_dataset(path, model), model)
    assert [e.name for e in found.effects] == ["input_rate_limit"]


def test_long_recordings_are_taken_in_longer_steps(tmp_path):
    model, path, _ = _recorded(tmp_path, 9, dt=0.002, steps=4500)
    data = load_dataset(path, model)
    longer, thin, _ = thinned(model, data)
    assert longer.dt == thin.dt == pytest.approx(0.006)
    assert np.sqrt(evaluate(problem(thin, steps_of(thin)), longer).noise.r[0]) < 0.8e-4  # three rows are in each


def test_a_force_that_flickers_within_parts_of_a_step_is_no_structure(tmp_path):
    """A controller at 1 kHz behind a coarse encoder: a part of a step has the force's mean, and where the joint is needs more."""
    rng, ms = np.random.default_rng(12), 1e-3
    u = _reversing(rng, 8000, ms)[:, 0] + rng.normal(size=8000)
    v = np.concatenate([[0.0], np.cumsum(u * ms / MASS)])[:-1]
    q = np.concatenate([[0.0], np.cumsum(v * ms + 0.5 * u * ms**2 / MASS)])[:-1]
    path = tmp_path / "run.csv"
    path.write_text("\n".join(["t,q,force", *(f"{k * ms:.9g},{round(q[k], 5):.9g},{u[k]:.9g}" for k in range(8000))]) + "\n")
    model = _joint(0.02)
    assert trace(load_dataset(path, model), model).verdict == "none"


def test_rows_that_lack_are_bridged_and_long_gaps_are_not(tmp_path):
    model, path, y = _recorded(tmp_path, 10, noise=1e-6, keep=lambda k: k % 40 or not k, wild=())
    data = load_dataset(path, model)
    assert np.isnan(data.runs[0].y[40, 0])
    whole = bridged(data).runs[0].y
    lacks = np.flatnonzero(np.isnan(whole[:, 0]))
    u = data.runs[0].u[:, 0]
    assert all(k % 40 == 0 and (u[k] != u[k - 1] or u[k + 1] != u[k]) for k in lacks)  # a command changed while nothing was recorded
    assert len(lacks) < 0.5 * len(range(40, len(whole), 40))
    assert np.nanmax(np.abs(whole[:-1, 0] - y[: len(whole) - 1, 0])) < 1e-4
    model, path, _ = _recorded(tmp_path, 10, keep=lambda k: not 500 <= k <= 500 + BRIEF)
    assert np.isnan(bridged(load_dataset(path, model)).runs[0].y[502, 0])


def test_a_bandwidth_that_is_asked_for_filters_as_before(tmp_path):
    model, path, _ = _recorded(tmp_path, 11)
    data = load_dataset(path, model, bandwidth=8.0)
    assert data.axes_without_speed == ()
    assert data.reconstruction.bandwidth == 8.0


@pytest.mark.parametrize(("corner", "is_late"), [(8.0, True), (None, False)])
def test_a_speed_that_a_controller_filtered_is_taken_from_the_position(tmp_path, corner, is_late):
    """A difference of positions through a low-pass of 8 Hz is 20 ms behind: friction would seem to come too late."""
    dt = 0.004
    model, path, y = _recorded(tmp_path, 12, (("coulomb_friction", "qd", {"force": 0.7}),), dt=dt, steps=2000, noise=2e-5)
    keep = np.exp(-2.0 * np.pi * (corner or 1e9) * dt)
    rows, speed, last = [], 0.0, None
    for line, (_, true) in zip(path.read_text().splitlines()[1:], y, strict=False):
        t, q, force = line.split(",")
        raw = 0.0 if last is None else (float(q) - last) / dt
        last = float(q)
        speed = keep * speed + (1.0 - keep) * raw
        rows.append(f"{t},{q},{speed if corner else true + 1e-3 * np.sin(1e3 * true):.9g},{force}")
    path.write_text("\n".join(["t,q,qd,force", *rows]) + "\n")
    data = load_dataset(path, model)
    assert (data.reconstruction is not None) == is_late
    found = trace(data, model)
    assert [(e.name, e.channel) for e in found.effects] == [("coulomb_friction", "qd")]
    assert found.effects[0].parameters["force"][0] == pytest.approx(0.7, rel=0.05)
    if is_late:
        assert found.to_json()["reconstructed"]["late_s"]["qd"] == pytest.approx(1.0 / (2.0 * np.pi * corner), rel=0.3)
        assert "late" in found.text()


@pytest.mark.parametrize("seed", range(6))
def test_a_command_that_changed_while_rows_were_lost_is_no_structure(tmp_path, seed):
    """A command that is lost with its row seems to come late: what lies in such a silence is not bridged, and counts for nothing."""
    lost = set(np.random.default_rng(100 + seed).choice(np.arange(1, 1199), 36, replace=False).tolist())
    model, path, *_ = _recorded(tmp_path, seed, steps=1200, noise=2e-5, keep=lambda k: k not in lost)
    result = trace(load_dataset(path, model), model)
    assert result.verdict in {"none", "sensor_fault"}, result.text()
