"""A suggested drive breaks the tie for which it was made: the loop is closed on robots of the tests' own."""

import csv
import io
import json
import math
import re
from pathlib import Path

import numpy as np
import pytest
from seeds import first
from trace_robots import commands, drive

from s2r_runtime.cli.main import main
from s2r_runtime.daemon.given_inputs import parse_inputs
from s2r_runtime.models.composed import compose
from s2r_runtime.modelspec import EffectSpec, ModelSpec, dump_model
from s2r_runtime.profile import load_profile
from s2r_runtime.trace.data.dataset import from_arrays
from s2r_runtime.trace.design.suggest import advice, suggest, suggest_first
from s2r_runtime.trace.design.suggestion import ENOUGH
from s2r_runtime.trace.pipeline import trace

pytestmark = pytest.mark.slow

DT, NOISE, STEPS = 0.05, np.array([0.002, 0.002, 0.006]), 1200
UNICYCLE = compose(ModelSpec("unicycle", DT, {}, (EffectSpec("integration_scheme", "*", {"scheme": "exact"}),)))


def constant_speed(rng):
    """v = 0.3 m/s all the time."""
    u = commands(rng, 1, STEPS, DT, [(0.0, 0.0), (-1.5, 1.5)], rest=0.0)
    u[:, :, 0] = 0.3
    return u


def two_yaw_rates(rng):
    """w is 0 or 1 rad/s."""
    u = np.zeros((1, STEPS, 2))
    u[0, :, 0] = 0.2
    edges = np.cumsum(rng.uniform(1.0, 3.0, STEPS) / DT).astype(int)
    u[0, :, 1] = np.searchsorted(edges, np.arange(STEPS), side="right") % 2
    return u


def slow_turns(rng):
    """w swings so slowly that being late and being slow look alike."""
    u = np.zeros((1, STEPS, 2))
    u[0, :, 0] = 0.2
    u[0, :, 1] = 0.3 * np.sin(0.15 * DT * np.arange(STEPS))
    return u


TIES = {
    "gain at constant speed": (constant_speed, ("input_gain", "v", {"gain": 0.8}), "input_bias"),
    "bias at constant speed": (constant_speed, ("input_bias", "v", {"bias": -0.06}), "input_gain"),
    "gain at two yaw rates": (two_yaw_rates, ("input_gain", "w", {"gain": 0.8}), "input_saturation"),
    "limit at two yaw rates": (two_yaw_rates, ("input_saturation", "w", {"low": -0.8, "high": 0.8}), "input_gain"),
    "delay in slow turns": (slow_turns, ("input_delay", "w", {"delay": 0.1}), "input_lag"),
    "lag in slow turns": (slow_turns, ("input_lag", "w", {"time_constant": 0.1}), "input_delay"),
}


def recorded(effects, u, seed=3):
    """One run of the robot, (y, u)."""
    return drive(np.random.default_rng(seed), "unicycle", u, effects, DT, NOISE)[0], u[0]


def named(found):
    return {(e.name, e.channel) for e in found}


SOON = ("bias at constant speed",)


@pytest.mark.parametrize("case", [case if case in SOON else pytest.param(case, marks=pytest.mark.slow) for case in TIES])
def test_the_suggested_drive_breaks_the_tie_and_the_right_effect_is_named(case):
    inputs, effect, rival = TIES[case]
    first = recorded([effect], inputs(np.random.default_rng(5)))
    before = trace(from_arrays(UNICYCLE, [first]), UNICYCLE)
    assert before.verdict == "ambiguous"
    assert {effect[:2], (rival, effect[1])} <= named(before.effects) | named(before.ambiguous_with)
    drive_next = suggest(before)
    assert drive_next.nats > ENOUGH
    second = recorded([effect], drive_next.u[None], seed=4)
    after = trace(from_arrays(UNICYCLE, [first, second]), UNICYCLE)
    assert after.rivals == ()
    assert named(after.effects) == {effect[:2]}


@pytest.fixture(scope="module")
def tied():
    return trace(from_arrays(UNICYCLE, [recorded([TIES["gain at two yaw rates"][1]], two_yaw_rates(np.random.default_rng(5)))]), UNICYCLE)


def test_the_drive_is_a_table_on_the_models_step_within_what_was_seen_and_begins_and_ends_at_rest(tied):
    found = suggest(tied, duration=12.0)
    rows = [[float(cell) for cell in row] for row in list(csv.reader(io.StringIO(found.to_csv())))[1:]]
    assert found.to_csv().startswith("t,v,w\n")
    table = np.array(rows)
    assert len(table) == 240
    assert np.allclose(np.diff(table[:, 0]), DT)
    assert np.allclose(table[:, 1:], found.u)
    assert found.bounds == {"v": (0.0, 0.2), "w": (0.0, 1.0)}
    assert table[:, 1].min() >= 0.0
    assert table[:, 1].max() <= 0.2
    assert not table[0, 1:].any()
    assert not table[-3:, 1:].any()
    assert "the range seen in the recording" in found.text()


def test_the_same_seed_gives_the_same_drive_and_another_seed_another(tied):
    first, again, other = (suggest(tied, duration=5.0, seed=seed) for seed in (1, 1, 2))
    assert np.array_equal(first.u, again.u)
    assert not np.array_equal(first.u, other.u)


def test_a_longer_drive_promises_more_and_says_after_how_many_rows_it_is_enough(tied):
    short, long = suggest(tied, duration=1.0), suggest(tied, duration=30.0)
    assert short.nats < long.nats
    assert long.rows == math.ceil(len(long.u) * ENOUGH / long.nats)
    assert f"{long.rows} rows" in long.text()


def test_the_robot_stays_in_the_region_that_a_profile_names_whatever_its_heading(tied):
    region = {"x": (1.0, 2.2), "y": (-0.5, 0.5)}
    found = suggest(tied, bounds={"v": (-0.4, 0.4), "w": (-2.0, 2.0)}, region=region)
    assert dict(found.begin) == {"x": 1.6, "y": 0.0}
    rng = np.random.default_rng(1)
    y = drive(rng, "unicycle", np.repeat(found.u[None], 12, axis=0), [TIES["gain at two yaw rates"][1]], DT, 0.0 * NOISE)
    away = np.hypot(y[:, :, 0] - y[:, :1, 0], y[:, :, 1] - y[:, :1, 1])
    assert away.max() < 0.5  # half of the region's narrow side, from its middle, in twelve directions
    assert away.max() == pytest.approx(found.farthest, rel=0.25)
    assert np.abs(found.u[:, 0]).max() <= 0.4
    assert "the range seen" not in found.text()


def test_what_nothing_within_the_bounds_tells_apart_is_refused_in_a_line():
    """At a speed that may not change, a gain and a bias stay the same thing."""
    effect = ("input_gain", "v", {"gain": 0.8})
    found = trace(from_arrays(UNICYCLE, [recorded([effect], constant_speed(np.random.default_rng(5)))]), UNICYCLE)
    refused = suggest(found, bounds={"v": (0.3, 0.3), "w": (-1.5, 1.5)}, duration=8.0)
    assert refused.u is None
    assert re.match(r"no inputs are suggested: no inputs within the bounds separate ", refused.text())
    assert "\n" not in refused.text()
    with pytest.raises(ValueError, match="separate"):
        refused.to_csv()


def test_advice_says_a_thing_once():
    model = compose(ModelSpec("unicycle", 0.05))
    assert advice(model, [("track_scale", "theta"), ("input_gain", "w")]) == "Drive w: at least three sizes."


def test_inputs_that_may_not_change_at_all_are_refused(tied):
    refused = suggest(tied, bounds={"v": (0.1, 0.1), "w": (0.0, 0.0)})
    assert refused.u is None
    assert "no input that may change" in refused.text()


def test_a_region_too_small_to_drive_in_is_kept_to_all_the_same(tied):
    found = suggest(tied, bounds={"v": (0.1, 0.2), "w": (0.0, 0.0)}, region={"x": (0.0, 0.2), "y": (0.0, 0.2)}, duration=10.0)
    assert found.u is None
    assert "stays inside the region" in found.text()


@pytest.mark.parametrize("name", first(2, ["double_integrator", "joint", "differential_drive", "bicycle"]))
def test_a_first_drive_shows_most_of_the_library_and_comes_back(name):
    """From a recording in which nothing happened, and the bounds of a profile."""
    dt, noise, bounds, region = {
        "double_integrator": (0.1, [0.003, 0.003, 0.005, 0.005], (-1.0, 1.0), {"x": (-2.0, 2.0), "y": (-2.0, 2.0)}),
        "joint": (0.01, [0.0005, 0.005], (-20.0, 20.0), {"q": (-0.5, 0.5), "qd": (-2.0, 2.0)}),
        "differential_drive": (0.05, [0.002, 0.002, 0.004, 0.03, 0.03], (-6.0, 6.0), {"x": (-1.5, 1.5), "y": (-1.5, 1.5)}),
        "bicycle": (0.05, [0.003, 0.003, 0.004, 0.02], (-0.4, 0.4), {"x": (-3.0, 3.0), "y": (-3.0, 3.0)}),
    }[name]
    model = compose(ModelSpec(name, dt))
    still = np.zeros((1, 200, len(model.inputs)))
    data = from_arrays(model, [(drive(np.random.default_rng(2), name, still, [], dt, np.array(noise))[0], still[0])])
    found = suggest_first(model, data, bounds=dict.fromkeys(model.inputs, bounds), region=region, duration=300 * dt, seed=0)
    assert found.u is not None
    told = [nats >= ENOUGH for *_, nats in found.pairs]
    assert sum(told) > 0.8 * len(told)
    y = drive(np.random.default_rng(3), name, found.u[None], [], dt, 0.0 * np.array(noise))[0]
    for state, (low, high) in region.items():
        path = y[:, model.states.index(state)] - (y[0, model.states.index(state)] if state in {"x", "y"} else 0.0)
        assert path.min() > low
        assert path.max() < high


def _written(path, y, u, dt=DT):
    rows = [",".join(("t", *UNICYCLE.states, *UNICYCLE.inputs))]
    rows += [",".join(f"{v:.8g}" for v in (dt * k, *y[k], *u[min(k, len(u) - 1)])) for k in range(len(y))]
    path.write_text("\n".join(rows) + "\n")


def test_the_command_line_writes_the_drive_and_says_what_it_promises(tmp_path, capsys):
    y, u = recorded([TIES["gain at two yaw rates"][1]], two_yaw_rates(np.random.default_rng(5)))
    recording, file = tmp_path / "tied.csv", tmp_path / "drive.csv"
    _written(recording, y, u)
    model = tmp_path / "unicycle.toml"
    model.write_text(dump_model(UNICYCLE.spec))
    given = ["trace", str(recording), "--model", str(model), "--suggest", str(file)]
    assert main([*given, "--suggest-duration", "6", "--json"]) == 0
    told = json.loads(capsys.readouterr().out)
    assert isinstance(told["suggested_excitation"], str)
    sequence = told["suggested_sequence"]
    assert (sequence["file"], sequence["bounds_from"]) == (str(file), "recording")
    assert sequence["separation_nats"] > ENOUGH
    assert len(file.read_text().splitlines()) == 121
    assert main([*given, "--suggest-duration", "6"]) == 0
    text = capsys.readouterr().out
    assert "nats between" in text
    assert f"drive written to {file}" in text


def test_a_length_without_a_file_is_a_usage_error(capsys):
    assert main(["trace", "x.csv", "--model", "unicycle", "--dt", "0.05", "--suggest-duration", "6"]) == 2
    assert "belongs to --suggest" in capsys.readouterr().err


def test_a_recording_in_which_nothing_was_asked_gets_a_first_drive_where_a_profile_says_what_is_allowed(tmp_path, capsys):
    profile = Path(__file__).parents[1] / "profiles" / "robotarium.toml"
    recording, file = tmp_path / "still.csv", tmp_path / "drive.csv"
    y = np.random.default_rng(1).normal(size=(201, 3)) * NOISE
    _written(recording, y, np.zeros((200, 2)), dt=0.033)
    assert main(["trace", str(recording), "--profile", str(profile), "--suggest", str(file), "--suggest-duration", "5"]) == 3
    out, err = capsys.readouterr()
    assert "every input is zero" in err
    assert "pairs of effects" in out
    robot = load_profile(profile)
    driven = parse_inputs(file.read_bytes(), "drive.csv", ("v", "w"), robot.inputs, robot.model.dt, {})  # what the daemon would drive
    table = np.loadtxt(file, delimiter=",", skiprows=1)
    assert np.array_equal(driven.rows, table[:, 1:])
    assert len(table) == round(5 / 0.033)
    assert np.abs(table[:, 1]).max() <= 0.2
    assert np.abs(table[:, 2]).max() > 1.0


def test_a_first_drive_is_told_as_json_too(tmp_path, capsys):
    """Beside the error: of twenty rows, where the inputs' bounds are seen; and where nothing was ever asked, why there is none."""
    y, u = recorded([], two_yaw_rates(np.random.default_rng(5)))
    file, model = tmp_path / "drive.csv", tmp_path / "unicycle.toml"
    model.write_text(dump_model(UNICYCLE.spec))
    for name, inputs, told in (("short", u[:19], True), ("still", 0.0 * u[:200], False)):
        recording = tmp_path / f"{name}.csv"
        _written(recording, y[: len(inputs) + 1], inputs)
        assert main(["trace", str(recording), "--model", str(model), "--suggest", str(file), "--json"]) == 3
        answer = json.loads(capsys.readouterr().out)
        assert answer["exit_code"] == 3
        drive_next = answer["suggested_sequence"]
        assert (drive_next["file"], drive_next["refused"] is None) == (str(file) if told else None, told)
        assert file.exists() is told
        file.unlink(missing_ok=True)
