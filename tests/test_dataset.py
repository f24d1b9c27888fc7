"""A recording lands on the model's grid as it was measured: exactly where it can, else on the nearest row."""

import gzip
import hashlib

import numpy as np
import pytest

from s2r_runtime.errors import RecordingError
from s2r_runtime.messages import Observation, Observed, Send
from s2r_runtime.models.composed import compose
from s2r_runtime.models.input_chains import Inputs
from s2r_runtime.modelspec import EffectSpec, ModelSpec
from s2r_runtime.recording.writer import Writer
from s2r_runtime.trace.data.dataset import Stream, from_arrays, from_streams, thinned
from s2r_runtime.trace.data.initial_conditions import with_history
from s2r_runtime.trace.data.readers import load_dataset
from s2r_runtime.trace.estimation.prediction import acting, first_steps, rollout_starts, steps_of


def _model(dt=0.1, name="unicycle", effects=()):
    return compose(ModelSpec(name, dt, {}, tuple(EffectSpec(*e) for e in effects)))


def _streams(n=50, dt=0.1, seed=1):
    rng = np.random.default_rng(seed)
    t = dt * np.arange(n)
    return Stream(t, rng.normal(size=(n, 3))), Stream(t, rng.normal(size=(n, 2)))


def test_rows_a_step_apart_are_taken_as_they_are():
    states, inputs = _streams()
    data = from_streams(_model(), [(states, inputs)], "here")
    assert data.substeps == 1
    assert np.array_equal(data.runs[0].y[:, :2], states.values[:, :2])
    assert np.array_equal(data.runs[0].u, inputs.values[:-1])


def test_rows_a_fraction_of_a_step_apart_are_picked_and_inputs_averaged():
    states, inputs = _streams(n=41, dt=0.025)
    data = from_streams(_model(), [(states, inputs)], "here")
    assert np.array_equal(data.runs[0].y[:, 0], states.values[::4, 0])
    mean = data.runs[0].u.reshape(10, data.substeps, 2).mean(axis=1)
    assert np.allclose(mean, inputs.values[:40].reshape(10, 4, 2).mean(axis=1))


def test_times_count_from_the_first_row_that_has_any_state():
    t = 3.0 + 0.05 * np.arange(100)
    values = np.random.default_rng(0).normal(size=(100, 3))
    values[::2, 2], values[1::2, :2] = np.nan, np.nan  # the heading comes half a step after the position, and first of all there is none
    data = from_streams(_model(), [(Stream(t, values), Stream(t, np.zeros((100, 2))))], "here")
    assert data.origin_s == 3.0
    measured = int(np.flatnonzero(~np.isnan(data.runs[0].y).any(axis=1))[0])
    assert data.runs[0].begins(data.dt)[measured] == pytest.approx(0.1)


@pytest.mark.parametrize(("rows", "parts"), [(0.6, 10), (9.4, 10), (10.4, 12), (11.45, 12), (13.7, 12)])
def test_a_step_within_which_commands_change_has_parts_in_pairs(rows, parts):
    """A grid half as fine tells what is left of the finer one: rows of commands (in a step) off the grid."""
    states, _ = _streams()
    t = np.arange(0.0, 5.0, 0.1 / rows) + 0.013
    data = from_streams(_model(), [(states, Stream(t, np.random.default_rng(2).normal(size=(len(t), 2))))], "here")
    assert data.substeps == parts


def test_irregular_rows_are_taken_as_they_are_and_a_gap_is_a_gap():
    t = np.concatenate([np.arange(0.0, 5.0, 0.013), np.arange(6.0, 9.0, 0.013)])
    u = np.stack([np.sin(t), np.cos(t)], axis=1)
    states = Stream(t, np.stack([2.0 * t, -t, 0.5 * t], axis=1))
    data = from_streams(_model(), [(states, Stream(t, u))], "here")
    run = data.runs[0]
    at = np.concatenate([[0.0], np.cumsum(run.lasts)])
    good = ~np.isnan(run.y[:, 0])
    assert np.isin(np.round(run.y[good, 0], 9), np.round(2.0 * t, 9)).all()
    assert np.allclose(run.y[good, 0], 2.0 * at[good])
    assert np.all(np.abs(at - 0.1 * np.arange(len(at))) <= 0.05 + 1e-9)
    assert not good[(at > 5.03) & (at < 5.97)].any()
    assert good[(at < 4.9) | (at > 6.1)].all()
    step = slice(20 * data.substeps, 21 * data.substeps)
    inside = np.linspace(at[20], at[21], 20001)
    held = u[np.searchsorted(t, inside, side="right") - 1]
    assert np.allclose(run.u[step].mean(axis=0), held.mean(axis=0), atol=1e-3)


@pytest.mark.parametrize(("spacing", "step"), [(0.13, 0.13), (0.16, 0.2), (0.11, 0.1), (0.1, 0.1)])
def test_where_rows_are_rarer_than_the_step_steps_are_longer_and_nothing_is_made_up_between_rows(spacing, step):
    t = np.arange(0.0, 9.0, spacing)
    states = Stream(t, np.stack([t**2, -t, 0.5 * t], axis=1))
    given = from_streams(_model(), [(states, Stream(t, np.zeros((len(t), 2))))], "here")
    model, data, _ = thinned(_model(), given)
    assert model.dt == pytest.approx(step)
    (run,) = data.runs
    there = ~np.isnan(run.y[:, 0])
    assert np.count_nonzero(there) >= 0.79 * len(run.y)
    assert np.isin(np.round(run.y[there, 1], 9), np.round(-t, 9)).all()


def test_angles_are_unwrapped_over_the_turn():
    t = np.arange(0.0, 10.0, 0.02)
    turned = 1.5 * t
    states = Stream(t, np.stack([t, t, (turned + np.pi) % (2 * np.pi) - np.pi], axis=1))
    data = from_streams(_model(), [(states, Stream(t, np.zeros((len(t), 2))))], "here")
    assert np.allclose(np.diff(data.runs[0].y[:, 2]), 0.15)


def test_the_mean_of_a_held_input_over_a_step_is_exact_whatever_its_stamps():
    t = 0.1 * np.arange(30)
    states = Stream(t, np.zeros((30, 3)))
    stamps = np.array([0.0, 0.33, 0.71, 1.234])
    inputs = Stream(stamps, np.array([[1.0, 0.0], [3.0, 0.0], [-1.0, 0.0], [2.0, 0.0]]))
    data = from_streams(_model(), [(states, inputs)], "here")
    mean = data.runs[0].u.reshape(29, data.substeps, 2).mean(axis=1)[:, 0]
    assert mean[3] == pytest.approx(0.3 * 1.0 + 0.7 * 3.0)
    assert mean[7] == pytest.approx(0.1 * 3.0 + 0.9 * -1.0)
    assert mean[12] == pytest.approx(0.34 * -1.0 + 0.66 * 2.0)
    assert mean[20] == pytest.approx(2.0)


def test_an_input_holds_until_the_next_and_is_zero_before_the_first():
    t = 0.1 * np.arange(20)
    inputs = Stream(np.array([0.5, 1.0]), np.array([[1.0, np.nan], [np.nan, 2.0]]))
    data = from_streams(_model(), [(Stream(t, np.zeros((20, 3))), inputs)], "here")
    assert data.runs[0].u[4].tolist() == [0.0, 0.0]
    assert data.runs[0].u[7].tolist() == [1.0, 0.0]
    assert data.runs[0].u[15].tolist() == [1.0, 2.0]


def test_rows_too_far_apart_for_the_step_are_refused_with_the_step_that_would_do():
    with pytest.raises(RecordingError, match=r"states are 0.1 s apart, the model's step is 0.03 s"):
        from_streams(_model(0.03), [_streams()], "here.csv")


@pytest.mark.parametrize(("rows", "spacing"), [(3, 0.2), (5, 0.5), (20, 0.3)])
def test_a_few_rows_that_come_seldom_decide_nothing_for_all(rows, spacing):
    """A fragment after a silence, of a logger that was starting or dying."""
    states, inputs = _streams(n=300)
    t = np.concatenate([states.t, 100.0 + spacing * np.arange(rows)])
    rng = np.random.default_rng(9)
    values = [np.concatenate([stream.values, rng.normal(size=(rows, stream.values.shape[1]))]) for stream in (states, inputs)]
    data = from_streams(_model(), [(Stream(t, values[0]), Stream(t, values[1]))], "here")
    assert (data.dt, data.apart) == (0.1, 1)
    assert np.array_equal(data.runs[0].y[:, :2], states.values[:, :2])


@pytest.mark.parametrize("slow", [0.2, 0.5, 1.0])
def test_a_long_run_with_few_rows_decides_nothing_either(slow):
    """A robot that was parked for a hundred seconds, and logged now and then meanwhile."""
    data = from_streams(_model(), [*(_streams(n=300) for _ in range(3)), _streams(n=round(80 / slow), dt=slow)], "here")
    assert (data.dt, data.apart) == (0.1, 1)


def test_a_few_rows_that_come_often_decide_nothing_for_all():
    with pytest.raises(RecordingError, match=r"states are 1 s apart"):
        from_streams(_model(), [_streams(n=300, dt=1.0), _streams(n=200)], "here.csv")


def test_of_two_rates_of_equal_time_the_slower_one_is_taken_so_that_all_rows_count():
    fast, slow = _streams(n=400), _streams(n=201, dt=0.2)
    data = from_streams(_model(), [fast, slow], "here")
    assert data.apart == 2
    assert [np.count_nonzero(np.isfinite(run.y).all(axis=1)) for run in data.runs] == [400, 201]


def test_a_long_silence_makes_two_runs():
    states, inputs = _streams(n=60)
    t = states.t + np.where(np.arange(60) >= 30, 100.0, 0.0)
    data = from_streams(_model(), [(Stream(t, states.values), Stream(t, inputs.values))], "here")
    assert [len(run.y) for run in data.runs] == [30, 30]
    assert data.runs[1].start_s == pytest.approx(103.0)


@pytest.mark.parametrize(("unit", "factor"), [("ms", 1e3), ("µs", 1e6), ("ns", 1e9)])
def test_stamps_that_are_no_seconds_are_told_by_the_models_step(unit, factor):
    t = factor * (1.7e9 + 0.1 * np.arange(50))
    with pytest.raises(RecordingError, match=f"here.csv: t seems to be in {unit}, must be in s"):
        from_streams(_model(), [(Stream(t, np.zeros((50, 3))), Stream(t, np.zeros((50, 2))))], "here.csv")


def test_a_table_with_segments_blanks_and_names_of_its_own_is_read(tmp_path):
    rows = ["part,t,px,y,theta,v,w"]
    rows += [f"a,{0.1 * k:.3f},{k},0,0,1,0" for k in range(10)]
    rows += ["a,1.000,,,,2,0", "a,1.100,11,0,0,,"]
    rows += [f"b,{0.1 * k:.3f},{-k},0,0,1,0" for k in range(5)]
    text = "\n".join(rows).replace("part", "segment")
    path = tmp_path / "run.csv.gz"
    path.write_bytes(gzip.compress(text.encode()))
    data = load_dataset(path, _model(), {"x": "px"})
    assert [len(run.y) for run in data.runs] == [12, 5]
    assert np.isnan(data.runs[0].y[10]).all()
    assert data.runs[0].u[10, 0] == 2.0
    assert len(steps_of(data)) == 9 + 4
    assert data.digests[0] == "sha256:" + hashlib.sha256(path.read_bytes()).hexdigest()


def test_a_log_gives_each_command_from_the_observation_that_it_answers(tmp_path):
    """The robot's clock runs 5 s behind the daemon's; every third answer comes 20 ms late."""
    path = tmp_path / "run.mcap"
    writer = Writer(path, run="run")
    second = 1_000_000_000
    for k in range(60):
        stamp, heard = k * second // 10, 5 * second + k * second // 10
        late = second // 50 if k % 3 == 0 else 0
        for _ in range(2):  # a robot that waits says the same again
            writer.write(Observed(heard, Observation(k, stamp, (0.1 * k, 0.0, 0.0))), heard)
        writer.write(Send(heard + late, k, "sampler", (float(k), 0.0), k, second), heard + late)
    writer.write(Observed(20 * second, Observation(99, 20 * second, (), "not a number")), 20 * second)
    writer.close()
    data = load_dataset(path, _model())
    assert len(data.runs) == 1
    assert np.allclose(data.runs[0].y[:, 0], 0.1 * np.arange(60))
    mean = data.runs[0].u.reshape(59, data.substeps, 2).mean(axis=1)[:, 0]
    assert mean[31] == pytest.approx(31.0)
    assert mean[30] == pytest.approx(0.2 * 29.0 + 0.8 * 30.0)


def test_parts_of_a_log_are_one_recording(tmp_path):
    paths = []
    for part in range(2):
        paths.append(tmp_path / f"part{part}.mcap")
        writer = Writer(paths[-1], run=f"run{part}")
        for k in range(40 * part, 40 * part + 40):
            t = k * 100_000_000
            writer.write(Observed(t, Observation(k, t, (0.0, 0.0, 0.0))), t)
            writer.write(Send(t, k, "sampler", (1.0, 0.0), k, 1), t)
        writer.close()
    data = load_dataset(paths, _model())
    assert [len(run.y) for run in data.runs] == [80]
    assert data.substeps == 1
    assert [digest.partition(":")[0] for digest in data.digests] == ["sha256", "sha256", "rows2"]


def test_steps_know_which_of_them_share_a_measurement():
    y = np.zeros((12, 3))
    y[5] = np.nan
    data = from_arrays(_model(), [(y, np.zeros((11, 2))), (np.zeros((4, 3)), np.zeros((3, 2)))])
    steps = steps_of(data, [(0, 8)])
    assert steps.place.tolist() == [0, 1, 2, 3, 6, 7, 9, 10, 11, 12, 13]
    assert steps.joined.tolist() == [False, True, True, True, False, True, False, True, False, True, True]
    assert first_steps(data).tolist() == [0, 11, 14]
    assert rollout_starts(data, 3, [(0, 8)]).tolist() == [0, 1, 3, 4, 11]


def test_short_runs_side_by_side_act_as_one_after_the_other():
    effects = [("input_delay", "w", {"delay": 0.17}), ("input_lag", "v", {"time_constant": 0.3})]
    model, rng = _model(effects=effects), np.random.default_rng(4)
    runs = [(np.zeros((n + 1, 3)), rng.normal(size=(n, 2))) for n in rng.integers(3, 12, 20)]
    together = acting(model, from_arrays(model, runs)).mean
    alone = np.concatenate([Inputs([u], 0.1, [0.0]).through(model, model.effects) for _, u in runs])
    assert np.allclose(together, alone, rtol=1e-12, atol=1e-14)


@pytest.mark.parametrize("unequal", [0, 3])
@pytest.mark.parametrize("count", [2, 9])
def test_what_acts_over_steps_is_the_mean_of_what_acts_in_their_parts(count, unequal):
    """Worked out input by input, once for all chains that share what acts on it; side by side (nine runs), or one after the other."""
    effects = [
        EffectSpec("input_lag", "speed_cmd", {"time_constant": 0.2}),
        EffectSpec("input_delay", "steer_cmd", {"delay": 0.13}),
        EffectSpec("input_coupling", "speed_cmd", {"from": "steer_cmd", "coefficient": 0.3}),
    ]
    model = compose(ModelSpec("bicycle", 0.1, {"wheel_base": 0.3}, tuple(effects)))
    rng, parts = np.random.default_rng(5), 4
    runs = [rng.normal(size=(parts * (12 + k % (unequal + 1)), 2)) for k in range(count)]
    inputs = Inputs(runs, 0.1 / parts, [0.0] * count, parts=parts)
    for chain in (model.effects, model.effects[:1], (), model.effects[1:], model.effects):
        mean, end = inputs.over_steps(model, chain)
        each = [Inputs([u], 0.1 / parts, [0.0], parts=parts).with_ends(model, chain) for u in runs]
        assert np.allclose(mean, np.concatenate([m.reshape(-1, parts, 2).mean(axis=1) for m, _ in each]), rtol=1e-12, atol=1e-13)
        assert np.allclose(end, np.concatenate([e[parts - 1 :: parts] for _, e in each]), rtol=1e-12, atol=1e-13)


def test_what_was_before_a_run_is_told_from_its_first_steps():
    model = _model(0.1)
    u = np.tile([[0.5, 0.3]], (40, 1))
    under_way = np.zeros((41, 3))
    for k in range(40):
        under_way[k + 1] = model.nominal.step(under_way[k : k + 1], u[k : k + 1], 0.1, {})[0]
    from_rest = np.concatenate([np.repeat(under_way[:1], 5, axis=0), under_way[:-5]])
    data = with_history(model, from_arrays(model, [(under_way, u), (from_rest, u)]))
    assert np.isnan(data.runs[0].y[:100]).all()
    assert np.array_equal(data.runs[0].u[:100], np.tile(u[:1], (100, 1)))
    assert data.runs[0].start_s == pytest.approx(-10.0)
    assert len(data.runs[1].y) == 41
    assert len(steps_of(data)) == 80


def test_a_wheel_that_was_turning_when_the_run_began_says_what_it_was_told_before():
    model = compose(ModelSpec("differential_drive", 0.1))
    still, coasting = np.zeros((41, 5)), np.zeros((41, 5))
    coasting[:, 3] = 4.0 * np.exp(-0.1 * np.arange(41))
    u = np.tile([[2.0, 3.0]], (40, 1))
    runs = with_history(model, from_arrays(model, [(coasting, u), (still, u)])).runs
    assert np.all(runs[0].u[: -40 * 5] == [4.0, 0.0]), "the left wheel's own speed, and nothing of the right one"
    assert np.isnan(runs[0].y[:-41]).all()
    assert len(runs[1].y) == 41


def test_a_silence_in_which_inputs_went_on_is_not_silent():
    t = 0.1 * np.arange(60)
    keep = (t < 3.0) | (t > 4.0)
    states = Stream(t[keep], np.zeros((int(keep.sum()), 3)))
    for stamps, silent in ((t, False), (t[keep], True)):
        data = from_streams(_model(), [(states, Stream(stamps, np.zeros((len(stamps), 2))))], "here")
        assert [p.silent for p in data.pauses] == [silent]


def test_a_heading_on_rows_of_its_own_does_not_turn_back_where_it_wraps():
    t = 0.05 * np.arange(201)
    heading = 2.5 + 0.4 * t
    values = np.column_stack([np.cos(t), np.sin(t), (heading + np.pi) % (2.0 * np.pi) - np.pi])
    values[1::2, :2] = np.nan
    values[::2, 2] = np.nan
    inputs = Stream(t[::2], np.tile([0.0, 0.4], (101, 1)))
    (run,) = from_streams(_model(0.1), [(Stream(t, values), inputs)], "here").runs
    there = ~np.isnan(run.y[:, 2])
    assert np.count_nonzero(there) > 90
    assert np.max(np.abs(np.diff(run.y[there, 2]) - 0.04)) < 1e-6


def test_a_stretch_without_a_step_is_none():
    t = np.concatenate([0.1 * np.arange(80), 60.0 + np.array([0.0, 0.01])])
    data = from_streams(_model(0.1), [(Stream(t, np.tile(t[:, None], (1, 3))), Stream(t, np.ones((82, 2))))], "here")
    assert len(data.runs) == 1
    with pytest.raises(RecordingError, match="no two rows"):
        from_streams(_model(0.1), [(Stream(t[-2:], np.zeros((2, 3))), Stream(t[-2:], np.ones((2, 2))))], "here")
