"""Steps that do not all last alike: what acts and what moves is given each step's own length."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from msgspec import structs
from numpy.typing import NDArray
from test_trace_arms_and_quadrotors import ARM

from s2r_runtime.models.composed import ComposedModel, compose
from s2r_runtime.models.file_model import FileModel
from s2r_runtime.models.forces import coupled
from s2r_runtime.models.input_chains import Inputs
from s2r_runtime.modelspec import EffectSpec, ModelSpec
from s2r_runtime.trace.data.dataset import from_streams
from s2r_runtime.trace.data.initial_conditions import with_history
from s2r_runtime.trace.data.reconstruction import at_step
from s2r_runtime.trace.data.split import part
from s2r_runtime.trace.data.streams import Stream
from s2r_runtime.trace.estimation.prediction import Acting, acting, advanced, residual, steps_of
from s2r_runtime.trace.hypotheses.input_dynamics import SHAPES, Shape
from s2r_runtime.trace.pipeline import trace

pytestmark = pytest.mark.slow

Array = NDArray[np.float64]

DT = 0.05
FINE = 2000
"""Parts of a second in which what acts is worked out for comparison; lengths below are whole numbers of them."""

ON_INPUTS: tuple[tuple[str, dict[str, Any]], ...] = (
    ("input_lag", {"time_constant": 0.13}),
    ("input_lag", {"time_constant": 0.004}),
    ("input_delay", {"delay": 0.0}),
    ("input_delay", {"delay": 0.087}),
    ("input_rate_limit", {"rate": 1.7}),
    ("input_rate_limit", {"rate": 3.0, "rate_down": 0.9}),
    ("periodic_disturbance", {"frequency": 1.3, "amplitude": 0.4, "phase": 0.7}),
    ("regime_change", {"time": 1.234, "gain": 0.4}),
    ("input_gain_drift", {"rate": 0.3}),
)

ON_STEPS: dict[str, tuple[tuple[str, str, dict[str, Any]], ...]] = {
    "unicycle": (
        ("integration_scheme", "*", {"scheme": "exact"}),
        ("lateral_slip", "*", {"coefficient": 0.3}),
        ("constant_disturbance", "body", {"x": 0.1, "y": 0.2}),
        ("gravity_slope", "*", {"x": 0.1, "y": -0.2}),
        ("position_field", "*", {"matrix": [[0.3, -0.1], [0.2, 0.4]]}),
        ("sensor_lever_arm", "*", {"x": 0.1, "y": 0.05}),
    ),
    "bicycle": (
        ("viscous_friction", "speed", {"coefficient_positive": 0.4, "coefficient_negative": 0.6}),
        ("understeer", "theta", {"coefficient": 0.1}),
        ("longitudinal_slip", "*", {"ratio": 0.1}),
    ),
    "differential_drive": (("track_scale", "theta", {"gain": 0.7}), ("constant_disturbance", "world", {"x": 0.1, "y": 0.2})),
    "joint": (
        ("stribeck_friction", "qd", {"force": 0.1, "static_force": 0.3, "velocity": 0.2}),
        ("cubic_stiffness", "q", {"coefficient": 0.4}),
        ("mass_change", "*", {"ratio": 1.3}),
    ),
    "double_integrator": (
        ("coulomb_friction", "vx", {"force": 0.3}),
        ("quadratic_drag", "vy", {"coefficient": 0.3}),
        ("position_field", "*", {"matrix": [[0.3, -0.1], [0.2, 0.4]]}),
    ),
}


def _uneven(rng: np.random.Generator, rows: int) -> Array:
    """(rows,) s: 0.3 to 1.7 steps, whole parts of a second."""
    return rng.integers(round(0.3 * DT * FINE), round(1.7 * DT * FINE) + 1, rows) / FINE


def _model(name: str, *effects: EffectSpec, dt: float = DT) -> ComposedModel:
    return compose(ModelSpec(name, dt, {}, effects))


@pytest.mark.parametrize(("name", "p"), ON_INPUTS)
def test_what_acts_is_what_acts_on_a_fine_grid(name: str, p: dict[str, Any]) -> None:
    """Three runs, each from rest, rows of any length: as in parts so fine that no row is cut."""
    rng = np.random.default_rng(3)
    model = _model("unicycle", EffectSpec(name, "v", p))
    starts = (0.0, 4.1, 9.7)
    inputs = [np.repeat(rng.normal(size=(rows // 3, 2)), 3, axis=0) for rows in (60, 30, 45)]
    lasts = [_uneven(rng, len(u)) for u in inputs]
    found = Inputs(inputs, DT, starts, lasts).through(model, model.effects)
    begin = 0
    for u, last, start in zip(inputs, lasts, starts, strict=True):
        parts = np.rint(last * FINE).astype(int)
        fine = Inputs([np.repeat(u, parts, axis=0)], 1.0 / FINE, [start]).through(model, model.effects)
        expected = np.add.reduceat(fine, np.cumsum(parts) - parts, axis=0) / parts[:, None]
        assert np.allclose(found[begin : begin + len(u)], expected, rtol=0.0, atol=1e-9)
        begin += len(u)


@pytest.mark.parametrize(("name", "p"), ON_INPUTS)
@pytest.mark.parametrize("runs", [1, 5])
def test_rows_that_all_last_alike_are_what_they_were(name: str, p: dict[str, Any], runs: int) -> None:
    """Given one by one or as one number; few runs or many."""
    rng = np.random.default_rng(4)
    model = _model("unicycle", EffectSpec("input_backlash", "v", {"width": 0.3}), EffectSpec(name, "v", p))
    inputs = [rng.normal(size=(40, 2)) for _ in range(runs)]
    starts = [3.0 * i for i in range(runs)]
    usual = Inputs(inputs, DT, starts).through(model, model.effects)
    each = Inputs(inputs, DT, starts, [np.full(40, DT)] * runs).through(model, model.effects)
    assert np.allclose(each, usual, rtol=0.0, atol=1e-9)


def test_a_delay_leaves_a_held_input_as_it_is() -> None:
    """Not but for rounding: what looks for changes would find one in every row."""
    rng = np.random.default_rng(5)
    model = _model("unicycle", EffectSpec("input_delay", "v", {"delay": 0.0871}))
    u = np.repeat(rng.normal(size=(8, 2)), 20, axis=0)
    found = Inputs([u], DT, [0.0], [_uneven(rng, len(u))]).through(model, model.effects)[:, 0]
    assert np.count_nonzero(np.diff(found)) <= 2 * 8


@pytest.mark.parametrize("even", [True, False], ids=["on the grid", "uneven"])
@pytest.mark.parametrize("gain", [1.0, 0.7])
def test_a_speed_is_what_was_commanded_last_however_late_in_its_step(even: bool, gain: float) -> None:
    """Commands nine tenths of a step after the states, each another one: half way through the last part of five. In what is fitted, too."""
    rng = np.random.default_rng(7)
    model = _model("bicycle", EffectSpec("input_gain", "speed_cmd", {"gain": gain}))
    t = 1.7e9 + np.cumsum(np.full(200, DT) if even else 0.8 * DT + 0.4 * DT * rng.random(200))
    u = rng.uniform(0.5, 1.5, (199, 2)) * [0.1, 1.0]
    y = np.cumsum(rng.normal(size=(200, 4)), axis=0)
    y[1:, 3] = gain * u[:, 1]
    data = with_history(model, from_streams(model, [(Stream(t, y), Stream(t[:-1] + 0.9 * np.diff(t), u))], "late"))
    some = np.zeros(sum(len(run.y) - 1 for run in data.runs), dtype=bool)
    some[-159:-49] = True  # behind what is taken to have been before
    for used in (data, part(data, (), some, 1000).data):
        off = residual(model, steps_of(used), acting(model, used))[1:-1, 3]
        assert np.max(np.abs(off)) < 1e-9


@pytest.mark.parametrize("even", [True, False], ids=["on the grid", "uneven"])
@pytest.mark.parametrize("runs", [1, 6])
def test_a_sine_is_added_to_what_was_commanded_last_however_late_in_its_step(even: bool, runs: int) -> None:
    """As it stands at the step's end. What a wheel does then is no mean of the commands before and after, not in half a millisecond."""
    rng = np.random.default_rng(8)
    model = _model("bicycle", EffectSpec("periodic_disturbance", "speed_cmd", {"frequency": 1.3, "amplitude": 0.4, "phase": 0.7}))
    made = []
    for begin in 10.0 * np.arange(runs):
        t = begin + np.cumsum(np.full(120, DT) if even else 0.8 * DT + 0.4 * DT * rng.random(120))
        u = np.repeat(rng.uniform(0.5, 1.5, (60, 2)), 2, axis=0)[:119] * [0.1, 1.0]
        y = np.cumsum(rng.normal(size=(120, 4)), axis=0)
        y[1:, 3] = u[:, 1] + 0.4 * np.sin(2.0 * np.pi * 1.3 * (t[1:] - (t[0] if not made else made[0][0].t[0])) + 0.7)
        made.append((Stream(t, y), Stream(t[:-1] + 0.93 * np.diff(t), u)))
    data = with_history(model, from_streams(model, made, "late"))
    assert any(run.turned is not None for run in data.runs)
    steps = steps_of(data)
    off = residual(model, steps, acting(model, data))[steps.joined & np.append(steps.joined[1:], False), 3]
    assert np.max(np.abs(off)) < 1e-5


@pytest.mark.parametrize("name", ON_STEPS)
def test_one_advance_is_as_many_as_there_are_lengths(name: str) -> None:
    """Every effect of stage step, alone and all of them together, on rows of lengths of their own."""
    rng = np.random.default_rng(6)
    chosen = [EffectSpec(*e) for e in ON_STEPS[name]]
    for effects in (*([e] for e in chosen), chosen):
        model = _model(name, *effects)
        assert model.uneven
        x, u = rng.normal(size=(30, len(model.states))), rng.normal(size=(30, len(model.inputs)))
        lasts = _uneven(rng, 30)
        act = Acting(u, u + 0.1, lasts)
        found = advanced(model, x, act, np.arange(30))
        for k in range(30):
            alone = _model(name, *effects, dt=float(lasts[k])).advance(x[k : k + 1], u[k : k + 1], u[k : k + 1] + 0.1)
            # forces that depend on the state are taken in parts of the step, whose number follows from the longest one
            assert np.allclose(found[k], alone[0], rtol=0.0, atol=1e-4 if name in {"joint", "double_integrator"} else 1e-12)


@pytest.mark.parametrize("shape", [s for s in SHAPES if s.uneven], ids=lambda s: s.name)
def test_shapes_remember_for_as_long_as_rows_last(shape: Shape) -> None:
    """As in parts so fine that no row is cut, but for how a shape is averaged over a row."""
    rng = np.random.default_rng(7)
    model = _model("unicycle")
    u = np.repeat(rng.normal(size=(20, 2)), 6, axis=0)
    lasts = _uneven(rng, len(u))
    parts = np.rint(lasts * FINE).astype(int)
    p = shape.starts(u, model.nominal, "v", DT, (0.3,))[0]
    found, usual = (shape.input_sequence(u, model.nominal, "v", dt, p)[:, 0] for dt in (lasts, DT))
    fine = shape.input_sequence(np.repeat(u, parts, axis=0), model.nominal, "v", 1.0 / FINE, p)[:, 0]
    expected = np.add.reduceat(fine, np.cumsum(parts) - parts) / parts
    errors = [float(np.sqrt(np.mean((e - expected) ** 2))) for e in (found, usual)]
    assert errors[0] < 0.5 * errors[1]


@pytest.mark.parametrize("slip", [-0.004, 0.02])
def test_a_robot_that_slides_to_either_side_does_so_whenever_its_rows_come(slip: float) -> None:
    """Stamps off the step make no sideways speed: a slip of less than two fifths of a step counts, too."""
    scheme = EffectSpec("integration_scheme", "*", {"scheme": "exact"})
    model, robot = _model("unicycle", scheme), _model("unicycle", scheme, EffectSpec("lateral_slip", "*", {"coefficient": slip}))
    rng = np.random.default_rng(6)
    lasts = _uneven(rng, 400)
    u = np.repeat(np.column_stack([rng.uniform(0.2, 1.0, 50), rng.uniform(-2.0, 2.0, 50)]), 8, axis=0)
    x = np.zeros((401, 3))
    for k, last in enumerate(lasts):
        x[k + 1] = _model("unicycle", *robot.spec.effects, dt=float(last)).step(x[k : k + 1], u[k : k + 1], robot.at_rest(1))[0][0]
    t = np.concatenate([[0.0], np.cumsum(lasts)])
    streams = Stream(t, x + rng.normal(size=x.shape) * 0.0005), Stream(t[:-1], u)
    found = trace(from_streams(model, [streams], "rows"), model)
    assert [(e.name, e.channel) for e in found.effects] == [("lateral_slip", "*")]


TANK = """
import numpy as np

STATES = ("level", "flow")
INPUTS = ("pump",)
PARAMS = {"outflow": 0.4}


def step(x, u, dt, params):
    LASTS
"""
AS_WRITTEN = {
    "by column": "return np.column_stack([x[:, 0] + dt * (u[:, 0] - params['outflow'] * np.sqrt(x[:, 0])), u[:, 0] + dt])",
    "by table": "return x + dt * np.hstack([u - params['outflow'] * np.sqrt(x[:, :1]), x[:, :1] - x[:, 1:]])",
    "of one length": "return x + float(dt) * np.hstack([u, -x[:, 1:]])",
    "of a mean": "return x + np.mean(dt) * np.hstack([u, -x[:, 1:]])",
    "in parts of the longest": "return x + np.max(dt) * np.hstack([u, -x[:, 1:]])",
    "by a mask": "y = x + dt * u; hit = y[:, 0] > 1.0; y[hit, 1] = y[hit, 1] + dt * u[hit, 0]; return y",
    "not at all": "return 0.9 * x + 0.1 * u",
    "out of bounds": "raise ValueError('no such tank')",
}


@pytest.mark.parametrize("written", AS_WRITTEN)
def test_a_model_of_ones_own_is_given_each_rows_length_if_its_step_takes_that(tmp_path: Path, written: str) -> None:
    (tmp_path / "tank.py").write_text(TANK.replace("LASTS", AS_WRITTEN[written]))
    model = compose(ModelSpec(str(tmp_path / "tank.py"), DT)).nominal
    takes = written in {"by column", "by table", "not at all"}
    assert getattr(model.shared, "uneven", None) is takes
    if takes:
        rng = np.random.default_rng(1)
        x, u, lasts = rng.uniform(0.5, 2.0, (40, 2)), rng.uniform(0.0, 1.0, (40, 1)), rng.uniform(0.02, 0.08, 40)
        alone = np.concatenate([model.step(x[[k]], u[[k]], float(lasts[k]), model.parameters) for k in range(40)])
        given: Any = lasts
        assert model.step(x, u, given, model.parameters) == pytest.approx(alone, rel=1e-12)


def test_a_step_that_counts_its_own_parts_is_not_asked_of_rows_one_by_one(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """It takes as long as there are parts in ten seconds."""
    source = "h = 0.0\n    while h < dt:\n        x, h = x + 1e-3 * u, h + 1e-3\n    return x"
    (tmp_path / "tank.py").write_text(TANK.replace("LASTS", source))
    model = compose(ModelSpec(str(tmp_path / "tank.py"), DT)).nominal
    called, asked = FileModel._called, []
    monkeypatch.setattr(FileModel, "_called", lambda self, *given: (asked.append(given), called(self, *given))[1])
    assert not getattr(model.shared, "uneven", None)
    assert len(asked) == 2


def test_a_model_that_does_not_take_each_rows_length_everywhere_is_interpolated_there(tmp_path: Path) -> None:
    """Its step is asked at some states only, and in others picks rows."""
    source = "y = x + dt * u; far = y[:, 0] > 1e9; y[far] += dt * u[far] if far.any() else 0.0; return y"
    (tmp_path / "tank.py").write_text(TANK.replace("LASTS", source))
    model, rng = compose(ModelSpec(str(tmp_path / "tank.py"), DT)), np.random.default_rng(4)
    assert model.uneven
    x, u, lasts = rng.choice([1e6, 3e9], (60, 2)), rng.uniform(0.0, 1e9, (60, 1)), rng.uniform(0.04, 0.06, 60)
    alone = [model.nominal.step(x[[k]], u[[k]], float(lasts[k]), model.parameters)[0] for k in range(60)]
    assert advanced(model, x, Acting(u, u, lasts), slice(None)) == pytest.approx(np.array(alone), rel=1e-9)


@pytest.mark.parametrize("stuck", [False, True])
def test_friction_between_links_acts_for_as_long_as_each_row_lasts(tmp_path: Path, stuck: bool) -> None:
    """Rows of four lengths at once are what they are length by length; stuck: most rows hold, and are settled before the others."""
    (tmp_path / "arm.py").write_text(ARM)
    effects = (
        EffectSpec("coulomb_friction", "dq1", {"force": 0.5}),
        EffectSpec("coulomb_friction", "dq2", {"force": 2.0 if stuck else 0.05}),
        EffectSpec("viscous_friction", "dq2", {"coefficient": 0.2}),
    )
    model, rng = _model(str(tmp_path / "arm.py"), *effects, dt=0.02), np.random.default_rng(2)
    assert coupled(model.nominal)
    assert model.uneven
    x, u = rng.uniform(-1.0, 1.0, (200, 4)), rng.uniform(-1.5, 1.5, (200, 2))
    lasts = rng.choice([0.008, 0.02, 0.021, 0.04], 200)
    act = Acting(u, u, lasts)
    together = advanced(model, x, act, slice(None))
    for length in np.unique(lasts):
        rows = np.flatnonzero(lasts == length)
        alone = advanced(replace(model, spec=structs.replace(model.spec, dt=float(length))), x[rows], Acting(u[rows], u[rows]), slice(None))
        assert together[rows] == pytest.approx(alone, rel=0.0, abs=1e-7)  # rounds end where forces hardly change


@pytest.mark.parametrize("apart", [1.1, 1.3, 1.45])
def test_wheels_that_turn_at_once_are_not_slow_where_rows_are_a_little_farther_apart_than_the_models_steps(apart):
    """Halfway between two rows a wheel has one speed or the other, and no mean of both."""
    dt, rows = 0.05, 500
    model = compose(ModelSpec("differential_drive", dt))
    robot = at_step(compose(ModelSpec("differential_drive", dt, {}, (EffectSpec("input_gain", "cmd_left", {"gain": 0.9}),))), apart * dt)
    rng = np.random.default_rng(4)
    u = np.repeat(rng.uniform(-6.0, 6.0, (rows // 4, 2)), 4, axis=0)
    x, y = np.zeros((1, 5)), [np.zeros(5)]
    for k in range(rows):
        x, _ = robot.step(x, u[k : k + 1], robot.at_rest(1))
        y.append(x[0])
    t = apart * dt * np.arange(rows + 1)
    measured = np.array(y) + rng.normal(size=(rows + 1, 5)) * [1e-3, 1e-3, 1e-3, 0.02, 0.02]
    found = trace(from_streams(model, [(Stream(t, measured), Stream(t[:-1], u))], "made"), model)
    assert [(e.name, e.channel) for e in found.effects] == [("input_gain", "cmd_left")]
    assert found.effects[0].values == {"gain": pytest.approx(0.9, abs=0.005)}
    assert (found.verdict, found.depends_on) == ("traced", ())
    if apart > 1.1:
        assert f"on steps of {apart * dt:.5g} s" in " ".join(found.done_to_data)
