"""A state that was not measured follows from those that were, within a stated bandwidth, and is not taken for more than that."""

import json
import math

import numpy as np
import pytest
from trace_robots import commands, drive

from s2r_runtime.errors import RecordingError
from s2r_runtime.models.composed import compose
from s2r_runtime.modelspec import EffectSpec, ModelSpec
from s2r_runtime.trace.data.dataset import from_arrays, thinned
from s2r_runtime.trace.data.differentiation import bandwidth, low_pass, reach
from s2r_runtime.trace.data.readers import load_dataset
from s2r_runtime.trace.data.reconstruction import reconstruct
from s2r_runtime.trace.data.streams import Stream
from s2r_runtime.trace.estimation.inverse_dynamics import input_relative, inverse
from s2r_runtime.trace.estimation.prediction import steps_of
from s2r_runtime.trace.pipeline import trace

DT = 0.01
GEOMETRY = {"joint": {"mass": 2.0}, "differential_drive": {"wheel_radius": 0.1, "track": 0.5}, "bicycle": {"wheel_base": 0.33}}
BOUNDS = {
    "joint": [(-3.0, 3.0)],
    "double_integrator": [(-1.0, 1.0)] * 2,
    "bicycle": [(-0.3, 0.3), (0.2, 1.5)],
    "differential_drive": [(0.0, 8.0)] * 2,
}
UNMEASURED = {
    "joint": ("qd",),
    "double_integrator": ("vx", "vy"),
    "bicycle": ("speed",),
    "differential_drive": ("wheel_left", "wheel_right"),
}


def _model(name, dt=DT, effects=(), **parameters):
    return compose(ModelSpec(name, dt, {**GEOMETRY.get(name, {}), **parameters}, tuple(EffectSpec(*e) for e in effects)))


def _recorded(path, model, y, u, lacking, dt):
    kept = [j for j, s in enumerate(model.states) if s not in lacking]
    rows = [",".join(["t", *(model.states[j] for j in kept), *model.inputs])]
    for k, inputs in enumerate(u):
        rows.append(",".join(f"{v:.9g}" for v in (k * dt, *y[k, kept], *inputs)))
    path.write_text("\n".join(rows) + "\n")
    return path


def _driven(path, name, seed, noise=1e-4, effects=(), steps=3000, dt=DT, lacking=None):
    rng = np.random.default_rng(seed)
    u = commands(rng, 1, steps, dt, BOUNDS[name])
    y = drive(rng, name, u, effects, dt, 0.0)[0]
    model = _model(name, dt)
    lacking = UNMEASURED[name] if lacking is None else lacking
    return model, y, _recorded(path, model, y + noise * rng.normal(size=y.shape), u[0], lacking, dt)


def test_a_low_pass_delays_nothing_and_its_derivative_is_exact_within_the_band():
    t = 0.01 * np.arange(2000)
    x = np.stack([2.0 + 3.0 * t, np.sin(2.0 * math.pi * 2.0 * t), np.sin(2.0 * math.pi * 30.0 * t)], axis=1)
    inner = slice(2 * reach(0.01, 10.0), -2 * reach(0.01, 10.0))
    smooth, slope, bend = (low_pass(x, 0.01, 10.0, order)[inner] for order in (0, 1, 2))
    w, s = 4.0 * math.pi, t[inner]
    assert np.allclose(smooth[:, 1], np.sin(w * s), atol=1e-3)
    assert np.allclose(slope[:, 1], w * np.cos(w * s), atol=1e-3 * w)
    assert np.allclose(bend[:, 1], -w * w * np.sin(w * s), atol=1e-3 * w * w)
    assert np.allclose(slope[:, 0], 3.0, atol=1e-4)
    assert np.all(np.abs(smooth[:, 2]) < 1e-3)


def test_the_bandwidth_grows_as_the_noise_falls():
    rng = np.random.default_rng(1)
    u = commands(rng, 1, 4000, DT, BOUNDS["joint"])
    q = drive(rng, "joint", u, (), DT, 0.0)[0][:, :1]
    found = [bandwidth([q + sigma * rng.normal(size=q.shape)], DT) for sigma in (1e-2, 1e-3, 1e-4, 1e-5)]
    assert found == sorted(found)
    assert found[0] < 0.5 * found[-1]


@pytest.mark.parametrize("name", UNMEASURED)
def test_states_that_follow_are_reconstructed(tmp_path, name):
    model, y, path = _driven(tmp_path / "run.csv", name, 2)
    needed = name in {"joint", "double_integrator"}  # a wheel's speed is looked at where somebody asks for it
    data = load_dataset(path, model, bandwidth=None if needed else 12.0)
    assert data.reconstruction.states == UNMEASURED[name]
    run = data.runs[0]
    k = np.flatnonzero(~np.isnan(run.y[:, 0])) + round(run.start_s / DT)  # origin is the first row that was not at the filter's edge
    k += round(data.origin_s / DT)
    columns = [model.states.index(s) for s in UNMEASURED[name]]
    error = run.y[~np.isnan(run.y[:, 0])][:, columns] - y[k][:, columns]
    assert np.all(np.sqrt(np.mean(error**2, axis=0)) < 0.15 * np.std(y[:, columns], axis=0))


def test_steps_that_share_a_filter_are_not_fitted_as_if_they_were_independent(tmp_path):
    model, _, path = _driven(tmp_path / "run.csv", "joint", 3, dt=0.002, steps=6000)
    data = load_dataset(path, model, bandwidth=20.0)
    longer, thin, _ = thinned(model, data)
    assert longer.dt == pytest.approx(0.5 / data.reconstruction.bandwidth, rel=0.3)
    assert thin.dt == longer.dt
    found = trace(data, model)
    assert found.spec.dt == 0.002
    assert found.to_json()["reconstructed"] == {"states": ["qd"], "bandwidth_hz": data.reconstruction.bandwidth}
    assert found.to_json()["step_s"] == longer.dt


@pytest.mark.slow
@pytest.mark.parametrize("name", ["joint", "double_integrator"])
def test_a_reconstructed_state_makes_no_effect(tmp_path, name):
    for seed in range(3):
        model, _, path = _driven(tmp_path / "run.csv", name, 10 + seed, noise=3e-4, steps=2000)
        assert trace(load_dataset(path, model), model).verdict == "none"


@pytest.mark.slow
def test_an_effect_is_found_without_its_velocity(tmp_path):
    model, _, path = _driven(tmp_path / "run.csv", "joint", 4, effects=[("input_lag", "force", {"time_constant": 0.1})])
    found = trace(load_dataset(path, model), model)
    assert found.verdict == "traced"
    assert [(e.name, e.channel) for e in found.effects] == [("input_lag", "force")]
    assert found.effects[0].parameters["time_constant"][0] == pytest.approx(0.1, abs=0.005)


def test_what_does_not_follow_is_refused_in_one_line(tmp_path):
    model, _, path = _driven(tmp_path / "run.csv", "joint", 5, lacking=("q",))
    with pytest.raises(RecordingError, match="lacks the column 'q'"):
        load_dataset(path, model)


def test_a_bandwidth_beyond_what_the_rows_show_is_refused(tmp_path):
    model, _, path = _driven(tmp_path / "run.csv", "joint", 6)
    with pytest.raises(RecordingError, match=r"rows 0.01 s apart show at most 50 Hz"):
        load_dataset(path, model, bandwidth=60.0)
    assert load_dataset(path, model, bandwidth=5.0).reconstruction.bandwidth == 5.0


def test_a_model_file_names_the_states_that_are_rates(tmp_path):
    source = tmp_path / "cart.py"
    source.write_text(
        "import numpy as np\nSTATES, INPUTS, PARAMS, RATES = ('p', 's'), ('f',), {}, {'s': 'p'}\n"
        "def step(x, u, dt, params):\n    return np.column_stack([x[:, 0] + dt * x[:, 1] + dt**2 / 2 * u[:, 0], x[:, 1] + dt * u[:, 0]])\n"
    )
    model = compose(ModelSpec(str(source), DT))
    t = DT * np.arange(500)
    rows = ["t,p,f"] + [f"{a:.4f},{b:.9g},{c:.9g}" for a, b, c in zip(t, 1 - np.cos(t), np.cos(t), strict=True)]
    path = tmp_path / "run.csv"
    path.write_text("\n".join(rows) + "\n")
    assert load_dataset(path, model).reconstruction.states == ("s",)


@pytest.mark.parametrize("lacking", [("qd",), ()])
def test_the_inverse_model_says_how_much_of_the_force_is_missing(tmp_path, lacking):
    """Of a force of which three quarters act, the model with the whole mass is a quarter short of explaining it; with the gain, nothing."""
    short, _, path = _driven(
        tmp_path / "run.csv", "joint", 7, noise=1e-5, effects=[("input_gain", "force", {"gain": 0.75})], lacking=lacking
    )
    data = load_dataset(path, short)
    given = inverse(short, data, steps_of(data))
    whole = _model("joint", effects=[("input_gain", "force", {"gain": 0.75})])
    assert input_relative(short, given) == pytest.approx(0.25, abs=0.01)
    assert input_relative(whole, given) < 0.03


def test_of_a_robot_that_was_held_still_while_it_was_judged_no_share_of_the_force_is_told():
    """The share of nothing is no number, and no JSON could hold it; the rest of the account stands."""
    model = _model("joint")
    rng, u = np.random.default_rng(1), np.zeros((1500, 1))
    u[825:] = np.repeat(rng.choice([-2.0, 2.0], 75), 9)[:, None]
    still = from_arrays(model, [(drive(rng, "joint", u[None], [], DT, [1e-3, 5e-3])[0], u)])
    steps = steps_of(still)
    assert input_relative(model, inverse(model, still, steps.take(np.arange(300, 750)))) is None
    said = trace(still, model).to_json()
    assert said["verdict"] == "none"
    json.dumps(said, allow_nan=False)


def test_inputs_that_are_no_forces_have_no_inverse_model(tmp_path):
    model, _, path = _driven(tmp_path / "run.csv", "bicycle", 8, steps=300)
    data = load_dataset(path, model)
    assert inverse(model, data, steps_of(data)) is None


def test_what_was_commanded_last_holds_through_a_silence_of_commands():
    """A last command of zero, and states that go on: what a low-pass makes of that command at its edge is not what holds on."""
    model = compose(ModelSpec("joint", 0.02, {"mass": 1.0}))
    t = 0.002 * np.arange(6000)
    held = 0.01 * np.arange(1200)
    rng = np.random.default_rng(3)
    u = 5.0 * np.repeat(rng.choice([-1.0, 1.0], 60), 20)
    silent = (held > 6.0) & (held < 8.5)
    u[np.flatnonzero(silent)[0] - 1] = 0.0
    acts = u.copy()
    acts[silent] = 0.0
    v = 0.002 * np.cumsum(np.repeat(acts, 5))
    q = 0.002 * np.cumsum(v) + 1e-6 * rng.normal(size=len(t))
    inputs = Stream(held[~silent], u[~silent, None])
    (made,), _ = reconstruct(model, [(Stream(t, q[:, None]), inputs)], ("qd",), "here", None)
    at = np.searchsorted(made[1].t, [6.3, 7.0, 8.0], side="right") - 1
    assert np.abs(made[1].values[at, 0]).max() < 1e-6
