"""A state of somebody's own model that nobody measured: another one tells it, and models are judged by what was measured."""

import json

import numpy as np
import pytest

from s2r_runtime.cli.main import main
from s2r_runtime.errors import RecordingError
from s2r_runtime.models.bound import integrating
from s2r_runtime.models.composed import compose
from s2r_runtime.modelspec import ModelSpec
from s2r_runtime.trace.data.readers import load_dataset
from s2r_runtime.trace.estimation.hidden_state import smoothed_hidden, told_through
from s2r_runtime.trace.pipeline import trace

DT_S, ROWS, PARTS, NOISE = 4.0, 500, 20, 0.01
TANKS = """
import numpy as np

STATES = ("upper", "lower")
INPUTS = ("pump",)
PARAMS = {"lift": 0.05, "k1": 0.054, "k2": 0.055, "k3": 0.055}


def step(x, u, dt, params):
    flow = np.sqrt(np.maximum(x, 0.0))
    upper = x[:, 0] + dt * (params["lift"] * u[:, 0] - params["k1"] * flow[:, 0])
    return np.column_stack([upper, x[:, 1] + dt * (params["k2"] * flow[:, 0] - params["k3"] * flow[:, 1])])
"""
"""A tank above another one, in Euler's steps of seconds; the robot flows."""


@pytest.fixture
def model(tmp_path):
    file = tmp_path / "tanks.py"
    file.write_text(TANKS)
    return compose(ModelSpec(str(file), DT_S))


def _flown(seed=0, gain=1.0, k1=0.054, k3=0.055, delay=0):
    """(t, levels without noise, pump)."""
    rng = np.random.default_rng(seed)
    t = DT_S * np.arange(ROWS)
    waves = np.linspace(0.0002, 0.0144, 40)
    u = np.cos(2.0 * np.pi * np.outer(t, waves) + rng.uniform(0.0, 2.0 * np.pi, 40)).sum(axis=1)
    u = np.clip(2.6 + 0.7 * u / np.std(u), 0.5, 6.0)
    upper, lower, levels = 5.2, 5.2, []
    for k in range(ROWS):
        levels.append((upper, lower))
        for _ in range(PARTS):
            part, out, through = DT_S / PARTS, np.sqrt(upper), np.sqrt(lower)
            upper += part * (0.05 * gain * u[max(k - delay, 0)] - k1 * out)
            lower += part * (0.055 * out - k3 * through)
    return t, np.array(levels), u


def _table(folder, columns, name="drive.csv"):
    path = folder / name
    rows = np.column_stack(list(columns.values()))
    text = [",".join(columns)] + [",".join("" if np.isnan(v) else f"{v:.6f}" for v in row) for row in rows]
    path.write_text("\n".join(text) + "\n")
    return path


def _lower_only(folder, seed=0, **what):
    t, levels, u = _flown(seed, **what)
    noise = np.random.default_rng(seed + 100).normal(size=ROWS) * NOISE
    return _table(folder, {"t": t, "lower": levels[:, 1] + noise, "pump": u})


def test_what_tells_a_hidden_state_is_what_it_moves(model):
    assert told_through(model.nominal, ["upper"]) == (("lower", "upper"),)
    assert told_through(model.nominal, ["lower"]) == ()  # it moves nothing that was measured
    assert told_through(model.nominal, ["upper", "lower"]) == ()
    assert told_through(compose(ModelSpec("unicycle", 0.1)).nominal, ["theta"]) == ()  # an angle


@pytest.mark.parametrize("what", [{}, {"gain": 0.8}])
def test_a_hidden_state_is_told_as_well_as_it_says_itself(model, what):
    """Also where the model is wrong about what drives it: what it does to the measured state says where it is."""
    t, levels, u = _flown(**what)
    x = np.column_stack([np.zeros(ROWS), levels[:, 1] + np.random.default_rng(1).normal(size=ROWS) * NOISE])
    nominal = integrating(model.nominal, "exact")
    told, (found,) = smoothed_hidden(nominal, t, x, u[:-1, None], DT_S, [("lower", "upper")], "drive")
    inside = slice(20, -20)  # at the ends it is known by one side only
    off = (told[inside, 0] - levels[inside, 0]) / found.error
    assert np.sqrt(np.mean(off**2)) < 1.5
    assert found.error < 0.2  # of a level of 5


@pytest.mark.slow
@pytest.mark.parametrize(
    ("what", "name", "channel", "values"),
    [
        ({"gain": 0.8}, "input_gain", "pump", {"gain": 0.8}),
        pytest.param({"k3": 1.15 * 0.055}, "parameter_change", "k3", {"ratio": 1.15}, marks=pytest.mark.slow),
        ({"k1": 0.85 * 0.054}, "parameter_change", "k1", {"ratio": 0.85}),
        ({"delay": 3}, "input_delay", "pump", {"delay": 12.0}),
    ],
)
def test_effects_are_named_with_their_numbers_though_one_tank_was_not_measured(tmp_path, model, what, name, channel, values):
    result = trace(load_dataset(_lower_only(tmp_path, **what), model), model)
    assert [(e.name, e.channel) for e in result.effects] == [(name, channel)]
    for parameter, true in values.items():
        value, low, high, _ = result.effects[0].parameters[parameter]
        assert value == pytest.approx(true, rel=0.01)
        assert low - 0.002 * true <= true <= high + 0.002 * true


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(2))
def test_a_model_that_is_right_gets_no_name_though_its_steps_are_coarse(tmp_path, model, seed):
    result = trace(load_dataset(_lower_only(tmp_path, seed), model), model)
    assert result.verdict == "none"


@pytest.mark.slow
def test_the_output_says_what_was_not_measured_and_that_steps_are_taken_in_parts(tmp_path, model, capsys):
    path = _lower_only(tmp_path, gain=0.8)
    repaired = tmp_path / "repaired.toml"
    assert main(["trace", str(path), "--model", model.spec.name, "--dt", "4", "-o", str(repaired)]) == 0
    said = " ".join(capsys.readouterr().out.split())
    assert "upper was not measured: what is left over is judged on lower alone (upper seen up to" in said
    assert "the model's steps are taken in parts" in said
    again = _lower_only(tmp_path, 5, gain=0.8)
    assert main(["trace", str(again), "--model", str(repaired), "--json"]) == 0
    answer = json.loads(capsys.readouterr().out)
    assert answer["verdict"] == "none"
    assert answer["reconstructed"]["states"] == ["upper"]


def test_a_column_without_a_value_is_a_state_that_was_not_measured(tmp_path, model):
    t, levels, u = _flown()
    path = _table(tmp_path, {"t": t, "upper": np.full(ROWS, np.nan), "lower": levels[:, 1], "pump": u})
    assert load_dataset(path, model).reconstruction.states == ("upper",)


def test_a_column_of_nearly_that_name_is_that_one_misspelt(tmp_path, model):
    t, levels, u = _flown()
    path = _table(tmp_path, {"t": t, "uper": levels[:, 0], "lower": levels[:, 1], "pump": u})
    with pytest.raises(RecordingError, match=r"lacks the column 'upper' \(nearest: 'uper'\)"):
        load_dataset(path, model)


def test_a_state_that_nothing_tells_is_missing(tmp_path, model):
    t, levels, u = _flown()
    path = _table(tmp_path, {"t": t, "upper": levels[:, 0], "pump": u})
    with pytest.raises(RecordingError, match="lacks the column 'lower'"):
        load_dataset(path, model)


def test_runs_and_lost_rows_are_told_each_by_itself(tmp_path, model):
    t, levels, u = _flown(gain=0.8)
    keep = np.ones(ROWS, dtype=bool)
    keep[300:320] = False
    path = _table(tmp_path, {"t": t[keep], "lower": levels[keep, 1], "pump": u[keep]})
    data = load_dataset(path, model)
    told = np.concatenate([run.y[:, 0] for run in data.runs])
    assert np.count_nonzero(np.isnan(told)) >= 20
    assert np.nanmax(np.abs(told[5:295] - levels[5:295, 0])) < 0.3


@pytest.mark.slow
def test_a_model_that_gives_no_numbers_beside_the_way_is_told_all_the_same(tmp_path):
    file = tmp_path / "strict.py"
    file.write_text(TANKS.replace("np.maximum(x, 0.0)", "np.where(x < 0.0, np.nan, x)"))
    strict = compose(ModelSpec(str(file), DT_S))
    result = trace(load_dataset(_lower_only(tmp_path, gain=0.8), strict), strict)
    assert [(e.name, e.channel) for e in result.effects] in ([("input_gain", "pump")], [("parameter_change", "lift")])  # one and the same


def test_a_model_that_gives_no_numbers_at_all_is_one_line(tmp_path):
    file = tmp_path / "none.py"
    file.write_text(TANKS.replace("np.maximum(x, 0.0)", "np.where(x[:, [1]] > 3.0, np.nan, x)"))
    none = compose(ModelSpec(str(file), DT_S))
    with pytest.raises(RecordingError, match="upper cannot be told: the model gives no numbers for this recording"):
        load_dataset(_lower_only(tmp_path), none)


def test_a_hidden_state_that_moves_nothing_for_a_while_is_told_where_it_does(tmp_path):
    """A valve between the tanks that is open eight rows of twenty."""
    file = tmp_path / "valve.py"
    file.write_text(
        TANKS.replace('INPUTS = ("pump",)', 'INPUTS = ("pump", "valve")').replace(
            'params["k2"] * flow[:, 0]', 'params["k2"] * u[:, 1] * flow[:, 0]'
        )
    )
    t, levels, u = _flown()
    valve = (np.arange(ROWS) % 20 < 8).astype(float)
    path = _table(tmp_path, {"t": t, "lower": levels[:, 1], "pump": u, "valve": valve})
    told = load_dataset(path, compose(ModelSpec(str(file), DT_S)))
    assert np.all(np.isfinite(told.runs[0].y))
    never = _table(tmp_path, {"t": t, "lower": levels[:, 1], "pump": u, "valve": 0.0 * valve}, "never.csv")
    with pytest.raises(RecordingError, match="upper cannot be told: nowhere in this recording does it move lower"):
        load_dataset(never, compose(ModelSpec(str(file), DT_S)))


WHOLE_STEPS = """
import numpy as np

STATES = ("a", "b")
INPUTS = ("u",)
PARAMS = {"k": 0.9}


def step(x, u, dt, params):
    return np.column_stack([params["k"] * x[:, 0] + 0.1 * u[:, 0], 0.8 * x[:, 1] + 0.2 * x[:, 0]])
"""


@pytest.mark.slow
def test_a_model_of_whole_steps_is_not_taken_in_parts(tmp_path):
    """As it was identified, whatever dt is: two of its halves are two of its steps."""
    file = tmp_path / "whole.py"
    file.write_text(WHOLE_STEPS)
    model = compose(ModelSpec(str(file), 0.1))
    rng = np.random.default_rng(0)
    u, x, rows = np.repeat(rng.normal(size=100), 8), np.zeros((1, 2)), []
    for pull in u:
        rows.append(x[0, 1])
        x = model.nominal.step(x, np.array([[0.8 * pull]]), 0.1, {"k": 0.9})
    path = _table(tmp_path, {"t": 0.1 * np.arange(800), "b": np.array(rows) + 1e-3 * rng.normal(size=800), "u": u})
    data = load_dataset(path, model)
    assert not data.reconstruction.in_parts
    result = trace(data, model)
    assert [(e.name, e.channel) for e in result.effects] == [("input_gain", "u")]
    assert result.effects[0].parameters["gain"][0] == pytest.approx(0.8, rel=0.01)


@pytest.mark.slow
def test_a_model_that_is_right_in_parts_is_written_in_parts(tmp_path, model, capsys):
    written = tmp_path / "written.toml"
    assert main(["trace", str(_lower_only(tmp_path)), "--model", model.spec.name, "--dt", "4", "-o", str(written), "--json"]) == 0
    answer = json.loads(capsys.readouterr().out)
    assert (answer["verdict"], answer["reconstructed"]["steps_in_parts"]) == ("none", True)
    assert "integration_scheme" in written.read_text()


def test_a_telling_angle_may_be_kept_within_one_turn(tmp_path):
    """A motor whose current nobody measured: its angle says how it turns, also where the file brings it back into a turn."""
    text = """
import numpy as np

STATES = ("angle", "rate")
INPUTS = ("volt",)
PARAMS = {"k": 2.0}
ANGLES = ("angle",)


def step(x, u, dt, params):
    rate = x[:, 1] + dt * (params["k"] * u[:, 0] - x[:, 1])
    angle = x[:, 0] + dt * rate
    return np.column_stack([np.arctan2(np.sin(angle), np.cos(angle)), rate])
"""
    rng = np.random.default_rng(0)
    told = []
    u = np.repeat(rng.uniform(-1.0, 3.0, 40), 15)
    for name, back in (("turns.py", "angle"), ("one_turn.py", "np.arctan2(np.sin(angle), np.cos(angle))")):
        file = tmp_path / name
        file.write_text(text.replace("np.arctan2(np.sin(angle), np.cos(angle))", back))
        model = compose(ModelSpec(str(file), 0.05))
        angle, rate, rows = 0.0, 0.0, []
        for volt in u:
            rows.append(angle)
            rate += 0.05 * (2.0 * volt - rate)
            angle += 0.05 * rate
        path = _table(tmp_path, {"t": 0.05 * np.arange(600), "angle": np.array(rows), "volt": u}, f"{name}.csv")
        told.append(load_dataset(path, model).runs[0].y[:, 1])
    assert np.allclose(*told, atol=1e-3)
