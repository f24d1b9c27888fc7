"""Transitions: which moments of a recording become samples, which do not and why, and that nothing is made up."""

from __future__ import annotations

import gzip
import hashlib
import itertools
import math
from pathlib import Path

import msgspec
import numpy as np
import pytest

from s2r_runtime.errors import NotEnoughEvidence, RecordingError, UsageError
from s2r_runtime.evidence.gap import blocked, estimate_gap, hold_residuals, refuse_fitted, residuals
from s2r_runtime.messages import CampaignFinished, Event, Observation, Observed, SampleTaken, Send
from s2r_runtime.models.composed import compose
from s2r_runtime.modelspec import EffectSpec, ModelSpec
from s2r_runtime.recording.writer import Writer
from s2r_runtime.recordings.loading import from_samples, load_transitions
from s2r_runtime.trace.data.readers import load_dataset

DT = 0.1
MODEL = compose(ModelSpec("unicycle", DT))
HEADER = "segment,t,x,y,theta,v,w"


def table(tmp_path: Path, rows: list[str], header: str = HEADER, name: str = "run.csv") -> Path:
    path = tmp_path / name
    path.write_text("\n".join([header, *rows]) + "\n")
    return path


# ---------------------------------------------------------------- segments


def test_first_row_of_each_segment_is_x0_and_x1_is_interpolated_at_dt(tmp_path: Path) -> None:
    path = table(
        tmp_path,
        [
            "a,10.00,0.0,1.0,3.10,0.2,1.0",
            "a,10.08,0.1,1.0,3.14,0.2,1.0",
            "a,10.12,0.3,2.0,-3.1031853,,",
            "a,10.20,0.4,2.0,-3.0,0.0,0.0",
            "b,0.00,5.0,5.0,0.0,0.1,0.0",
            "b,0.10,6.0,5.0,0.5,0.1,0.0",
        ],
    )
    tr = load_transitions(path, MODEL)
    assert tr.independent
    assert tr.rejected == {}
    np.testing.assert_allclose(tr.x0, [[0.0, 1.0, 3.1], [5.0, 5.0, 0.0]])
    np.testing.assert_allclose(tr.u, [[0.2, 1.0], [0.1, 0.0]])
    np.testing.assert_allclose(tr.x1, [[0.2, 1.5, -3.1231853], [6.0, 5.0, 0.5]], atol=1e-7)
    np.testing.assert_allclose(tr.t0_s, [10.0, 0.0])
    assert tr.digest == "sha256:" + hashlib.sha256(path.read_bytes()).hexdigest()


def test_segments_that_give_no_transition_are_counted_by_reason(tmp_path: Path) -> None:
    good = ["good,0.0,0,0,0,0.1,0.5", "good,0.1,0,0,0,0.1,0.5"]
    changed = ["changed,0.0,0,0,0,0.1,0.5", "changed,0.05,,,,0.2,0.5", "changed,0.1,0,0,0,0.2,0.5"]
    short = ["short,0.0,0,0,0,0.1,0.5", "short,0.09,0,0,0,0.1,0.5"]
    unsent = ["unsent,0.0,0,0,0,,0.5", "unsent,0.1,0,0,0,0.1,0.5"]
    blank = ["blank,0.0,0,,0,0.1,0.5", "blank,0.1,0,0,0,0.1,0.5"]
    tr = load_transitions(table(tmp_path, good + changed + short + unsent + blank), MODEL)
    assert len(tr.x0) == 1
    assert tr.rejected == {"input_changed": 1, "too_short": 1, "no_input": 1, "first_row_incomplete": 1}


def test_rows_too_far_apart_to_show_one_step_are_no_transition(tmp_path: Path) -> None:
    good = [f"g{i},{t},0,0,0,0.1,0.5" for i in range(3) for t in (0.0, 0.1)]
    coarse = ["coarse,0.0,0,0,0,0.1,0.5", "coarse,1.0,0,0,0,0.1,0.5"]
    blank = ["blank,0.0,0,0,0,0.1,0.5", "blank,0.1,,0,0,0.1,0.5"]
    twice = ["twice,0.0,0,0,0,0.1,0.5", "twice,0.0,0,0,0,0.1,0.5"]
    tr = load_transitions(table(tmp_path, good + coarse + blank + twice), MODEL)
    assert tr.rejected == {"too_coarse": 1, "not_received": 1, "duplicate_stamp": 1}
    assert len(tr.x0) == 3
    with pytest.raises(RecordingError, match=r"rows are 100 s apart, the model's step is 0\.1 s.*is t in seconds\?"):
        load_transitions(table(tmp_path, [f"s{i},{t},0,0,0,0.1,0.5" for i in range(3) for t in (0, 100)]), MODEL)


def test_an_input_that_changes_when_the_step_is_over_has_held_long_enough(tmp_path: Path) -> None:
    rows = [f"{s},{s * 0.7 + k / 10:.1f},0,0,0,{0.1 if k == 0 else 0.2},0" for s in range(7) for k in range(3)]
    assert load_transitions(table(tmp_path, rows), MODEL).rejected == {}


def test_rows_of_one_stamp_are_one_row(tmp_path: Path) -> None:
    tr = load_transitions(table(tmp_path, ["a,0,1,2,0.5,,", "a,0,,,,0.1,0.2", "a,0.1,1.1,2,0.5,,"]), MODEL)
    np.testing.assert_allclose(tr.x0, [[1.0, 2.0, 0.5]])
    np.testing.assert_allclose(tr.u, [[0.1, 0.2]])


def test_hold_ends_where_all_segments_still_hold(tmp_path: Path) -> None:
    rows = []
    for name, held in (("a", 5), ("b", 4)):
        for k in range(8):
            v, w = (0.1, 0.5) if k < held else (0.0, 0.0)
            rows.append(f"{name},{k * DT:.1f},{k},{2 * k},{0.01 * k},{v},{w}")
    tr = load_transitions(table(tmp_path, rows), MODEL)
    assert tr.hold_periods == 4
    assert tr.held is not None
    np.testing.assert_allclose(tr.held, [[4, 8, 0.04], [4, 8, 0.04]])
    tr = load_transitions(table(tmp_path, [*rows, "c,0,0,0,0,0.1,0", "c,0.1,0,0,0,0.1,0", "c,0.2,0,0,0,0,0"]), MODEL)
    assert tr.hold_periods == 2
    tr = load_transitions(table(tmp_path, [*rows, "c,0,0,0,0,0.1,0", "c,0.1,0,0,0,0,0"]), MODEL)
    assert (tr.hold_periods, tr.held) == (1, None)


def simulated(model, n: int, periods: int, rng: np.random.Generator) -> tuple[list[str], np.ndarray]:
    """Rows of a campaign in which the robot is `model`, and the inputs."""
    rows, inputs = [], rng.uniform((-0.2, -2), (0.2, 2), (n, 2))
    for i, u in enumerate(inputs):
        x, hidden = rng.uniform((-1, -1, -3), (1, 1, 3), (1, 3)), model.at_rest(1)
        for k in range(periods + 1):
            rows.append(",".join([str(i), repr(float(i * 9 + k * DT)), *map(repr, x[0].tolist()), *map(repr, u.tolist())]))
            x, hidden = model.step(x, u[None, :], hidden)
    return rows, inputs


def test_an_exact_model_has_no_gap_and_no_hold_gap(tmp_path: Path) -> None:
    model = compose(ModelSpec("unicycle", DT, effects=(EffectSpec("input_delay", "*", {"delay": 0.15}),)))
    rows, inputs = simulated(model, 80, 12, np.random.default_rng(1))
    tr = load_transitions(table(tmp_path, rows), model)
    assert tr.hold_periods == 12
    np.testing.assert_allclose(tr.u, inputs)
    assert np.abs(residuals(model, tr)).max() < 1e-12
    e_hold = hold_residuals(model, tr)
    assert e_hold is not None
    assert np.abs(e_hold).max() < 1e-12
    gap = estimate_gap(model, tr, epsilon=0.05, beta=0.05, weights=(1.0, 1.0, 1.0))
    assert max(gap.radius, gap.hold_radius) < 1e-12
    assert gap.hold_periods == 12
    assert estimate_gap(MODEL, tr, epsilon=0.05, beta=0.05, weights=(1.0, 1.0, 1.0)).radius > 0.05


def test_columns_may_have_other_names_and_a_wrong_one_is_told_with_the_nearest(tmp_path: Path) -> None:
    path = table(tmp_path, ["0,0,1,2,3,0.1,0.2", "0,0.1,1,2,3,0.1,0.2"], "segment,t,pos_x,pos_y,yaw,v,w")
    names = {"x": "pos_x", "y": "pos_y", "theta": "yaw"}
    assert len(load_transitions(path, MODEL, names).x0) == 1
    with pytest.raises(RecordingError, match=r"lacks the column 'yaww' \(nearest: 'yaw'\)"):
        load_transitions(path, MODEL, {**names, "theta": "yaww"})


def test_gzip_and_plain_text_give_the_same_transitions(tmp_path: Path) -> None:
    rows, _ = simulated(MODEL, 10, 3, np.random.default_rng(2))
    plain = table(tmp_path, rows)
    packed = tmp_path / "run.csv.gz"
    packed.write_bytes(gzip.compress(plain.read_bytes()))
    np.testing.assert_array_equal(load_transitions(plain, MODEL).x1, load_transitions(packed, MODEL).x1)


# ---------------------------------------------------------------- driving


def drive_rows(t_x: np.ndarray, t_u: np.ndarray, missing: tuple[float, float] = (math.inf, math.inf)) -> list[str]:
    """x = 0.3 t along a line, heading 2 t - 3 wrapped; input k at t_u[k] is (k, -k). No states in `missing`."""
    rows = [
        (t, f"{t!r},{0.3 * t!r},0.0,{math.remainder(2 * t - 3, 2 * math.pi)!r},,") for t in t_x.tolist() if not missing[0] < t < missing[1]
    ]
    rows += [(t, f"{t!r},,,,{float(k)!r},{-float(k)!r}") for k, t in enumerate(t_u.tolist())]
    return [text for _, text in sorted(rows)]


def test_driving_gives_consecutive_transitions_that_are_not_independent(tmp_path: Path) -> None:
    rng = np.random.default_rng(3)
    t_x = np.cumsum(rng.uniform(0.01, 0.03, 400))
    t_u = np.cumsum(rng.uniform(0.005, 0.04, 300))
    tr = load_transitions(table(tmp_path, drive_rows(t_x, t_u), "t,x,y,theta,v,w"), MODEL)
    assert not tr.independent
    assert "ordinary driving" in tr.doubt
    start = t_x[0]
    steps = np.rint((tr.t0_s - start) / DT)
    np.testing.assert_allclose(tr.t0_s, start + steps * DT, atol=1e-9)
    assert np.all(np.diff(steps) == 1)
    np.testing.assert_allclose(tr.x0[:, 0], 0.3 * tr.t0_s, atol=1e-9)
    np.testing.assert_allclose(tr.x1[:, 0], 0.3 * (tr.t0_s + DT), atol=1e-9)
    turn = np.remainder(tr.x1[:, 2] - tr.x0[:, 2] + math.pi, 2 * math.pi) - math.pi
    np.testing.assert_allclose(turn, 2 * DT, atol=1e-9)
    fine = tr.t0_s[:, None] + (np.arange(20_000) + 0.5) / 20_000 * DT
    held = np.searchsorted(t_u, fine, side="right") - 1.0
    np.testing.assert_allclose(tr.u[:, 0], held.mean(axis=1), atol=1e-3)
    np.testing.assert_allclose(tr.u[:, 1], -tr.u[:, 0])


def test_holes_in_the_states_and_time_before_the_first_input_are_left_out_and_counted(tmp_path: Path) -> None:
    t_x, t_u = np.arange(0, 5.0001, 0.02), np.arange(0.55, 5, 0.1)
    tr = load_transitions(table(tmp_path, drive_rows(t_x, t_u, (2.02, 2.78)), "t,x,y,theta,v,w"), MODEL)
    assert tr.rejected == {"no_input": 6, "state_gap": 8}
    assert len(tr.x0) == 50 - 14
    assert not np.any((tr.t0_s > 1.95) & (tr.t0_s < 2.75))
    assert tr.drive is not None
    np.testing.assert_array_equal(tr.drive.inputs[0][tr.drive.step], tr.u)


def test_commands_inside_a_hole_of_the_states_still_move_the_memory(tmp_path: Path) -> None:
    model = compose(ModelSpec("unicycle", DT, effects=(EffectSpec("input_delay", "*", {"delay": 0.3}),)))
    rng = np.random.default_rng(4)
    x, hidden, rows = np.zeros((1, 3)), model.at_rest(1), []
    for k in range(100):
        u = rng.uniform((-0.2, -2), (0.2, 2), (1, 2))
        state = ",".join(map(repr, x[0].tolist())) if not 40 <= k < 50 else ",,"
        rows.append(f"{k * DT!r},{state},{float(u[0, 0])!r},{float(u[0, 1])!r}")
        x, hidden = model.step(x, u, hidden)
    tr = load_transitions(table(tmp_path, rows, "t,x,y,theta,v,w"), model)
    assert tr.rejected == {"state_gap": 11}
    assert np.abs(residuals(model, tr)).max() < 1e-9


def test_after_a_long_silence_a_drive_begins_anew(tmp_path: Path) -> None:
    t = np.concatenate([np.arange(0, 3, 0.05), np.arange(500, 503, 0.05)])
    tr = load_transitions(table(tmp_path, drive_rows(t, t), "t,x,y,theta,v,w"), MODEL)
    assert tr.drive is not None
    assert len(tr.drive.inputs) == 2
    assert len(tr.x0) == 58
    assert tr.rejected == {}


def test_noise_of_a_stream_is_seen_and_a_stream_too_coarse_for_dt_gives_nothing(tmp_path: Path) -> None:
    rng = np.random.default_rng(5)
    sigma = np.array([0.002, 0.004, 0.01])
    t = np.cumsum(rng.uniform(0.01, 0.03, 3000))
    noise = rng.normal(size=(len(t), 3)) * sigma
    rows = [
        f"{s!r},{math.sin(s) + e[0]!r},{math.cos(s) + e[1]!r},{math.remainder(s + e[2], 2 * math.pi)!r},0.1,0.0"
        for s, e in zip(t.tolist(), noise.tolist(), strict=True)
    ]
    tr = load_transitions(table(tmp_path, rows, "t,x,y,theta,v,w"), MODEL)
    assert tr.noise is not None
    np.testing.assert_allclose(tr.noise, sigma, rtol=0.1)  # median of 3000 correlated values: 3 % standard error
    coarse = load_transitions(table(tmp_path, rows[::20], "t,x,y,theta,v,w"), MODEL)
    assert len(coarse.x0) < 20
    assert coarse.rejected["state_gap"] > 100


# ---------------------------------------------------------------- logs


def sample(index: int, epoch: int = 1, periods: int = 10) -> SampleTaken:
    x = float(index)
    held = (x + 1.0, 0.0, 0.0) if periods > 1 else ()
    return SampleTaken(
        index * 10**9, epoch, index, index * 100, index * 10**9, (0.1, 0.2), (x, 0.0, 0.0), (x + 0.01, 0.0, 0.02), held, periods
    )


def log(tmp_path: Path, events: list[Event | Send], name: str = "run.mcap") -> Path:
    path = tmp_path / name
    writer = Writer(path, run="r1")
    for k, event in enumerate(events):
        writer.write(event, k)
    writer.close()
    return path


def finished(epoch: int, n: int, complete: bool = True) -> CampaignFinished:
    return CampaignFinished(0, epoch, n, complete, {"timeout": 2})


def test_the_last_complete_campaign_of_a_log_counts_and_another_can_be_asked_for(tmp_path: Path) -> None:
    events = [sample(i) for i in range(4)] + [finished(1, 4)]
    events += [sample(i, 2) for i in range(6)] + [finished(2, 6)]
    events += [sample(i, 3) for i in range(3)]
    path = log(tmp_path, events)
    tr = load_transitions(path, MODEL)
    assert (len(tr.x0), tr.independent, tr.hold_periods, tr.rejected) == (6, True, 10, {"timeout": 2})
    np.testing.assert_allclose(tr.x1 - tr.x0, [[0.01, 0.0, 0.02]] * 6)
    assert tr.digest == "sha256:" + hashlib.sha256(path.read_bytes()).hexdigest()
    assert len(load_transitions(path, MODEL, epoch=1).x0) == 4
    with pytest.raises(RecordingError, match="has no samples of epoch 7; it has samples of: 1, 2, 3"):
        load_transitions(path, MODEL, epoch=7)


@pytest.mark.parametrize(
    ("ending", "doubt"),
    [
        ([], "did not end in this log"),
        ([finished(1, 5, complete=False)], "was ended after 5 samples, before all"),
        ([finished(1, 9)], "the log holds 5 of the 9 samples"),
    ],
)
def test_samples_of_a_campaign_that_is_not_whole_carry_no_statement(tmp_path: Path, ending: list[Event], doubt: str) -> None:
    tr = load_transitions(log(tmp_path, [sample(i) for i in range(5)] + ending), MODEL)
    assert not tr.independent
    assert doubt in tr.doubt
    assert len(tr.x0) == 5


def test_a_sample_logged_once_more_counts_once(tmp_path: Path) -> None:
    samples = [sample(i) for i in range(5)]
    repeated = [msgspec.structs.replace(s, again=True) for s in samples[:3]]
    tr = load_transitions(log(tmp_path, [*samples[:3], *repeated, *samples[3:], finished(1, 5)]), MODEL)
    assert tr.independent
    assert tr.samples_digest == from_samples(samples).digest


def test_samples_have_a_digest_of_their_own_that_every_log_of_them_shares(tmp_path: Path) -> None:
    samples = [sample(i) for i in range(5)]
    one = load_transitions(log(tmp_path, [*samples, finished(1, 5)], "a.mcap"), MODEL)
    other = load_transitions(log(tmp_path, [finished(9, 0), *samples, finished(1, 5)], "b.mcap"), MODEL)
    assert one.digest != other.digest
    assert one.samples_digest == other.samples_digest == from_samples(samples).digest
    assert from_samples([*samples[:4], sample(9)]).digest != one.samples_digest
    fitted = compose(ModelSpec("unicycle", DT, fitted_on=(one.samples_digest,)))
    with pytest.raises(NotEnoughEvidence, match="was fitted on this recording"):
        estimate_gap(fitted, other, epsilon=0.5, beta=0.5, weights=(1.0, 1.0, 1.0))


def test_a_log_without_samples_is_driving_with_commands_at_the_robot_s_stamps(tmp_path: Path) -> None:
    model = compose(ModelSpec("unicycle", DT, effects=(EffectSpec("input_delay", "*", {"delay": 0.1}),)))
    rng = np.random.default_rng(6)
    x, hidden, events, last = np.zeros((1, 3)), model.at_rest(1), [], np.zeros((1, 2))
    for k in range(60):
        u = rng.uniform((-0.2, -2), (0.2, 2), (1, 2))
        robot_ns, host_ns = 7 * 10**9 + k * 10**8, k * 10**8 + 123
        fault = "not finite" if k == 30 else ""
        events.append(Observed(host_ns, Observation(k, robot_ns, () if fault else tuple(x[0].tolist()), fault)))
        if not fault:
            events.append(Send(host_ns, k, "controller", tuple(u[0].tolist()), k, 10**8))
        else:
            u = last
        x, hidden = model.step(x, u, hidden)
        last = u
    tr = load_transitions(log(tmp_path, events), model)
    assert not tr.independent
    assert len(tr.x0) == 59 - 2
    assert np.abs(residuals(model, tr)).max() < 1e-7


def test_samples_of_different_models_and_no_samples_are_refused() -> None:
    with pytest.raises(RecordingError, match="holds no samples"):
        from_samples([])
    odd = SampleTaken(0, 1, 1, 0, 0, (0.1,), (0.0,), (0.1,), (), 1)
    with pytest.raises(RecordingError, match="are not of one model"):
        from_samples([sample(0), odd])


def test_samples_held_for_one_period_or_unequally_have_no_hold(tmp_path: Path) -> None:
    for samples in ([sample(i, periods=1) for i in range(3)], [sample(i, periods=10 + i) for i in range(3)]):
        tr = from_samples(samples)
        assert (tr.held, tr.hold_periods) == (None, 1)


# ---------------------------------------------------------------- bad input


def test_a_file_that_is_not_there_and_one_that_is_no_log_are_named(tmp_path: Path) -> None:
    with pytest.raises(RecordingError, match=r"none\.mcap: cannot be read"):
        load_transitions(tmp_path / "none.mcap", MODEL)
    path = tmp_path / "text.mcap"
    path.write_text("t,x\n")
    with pytest.raises(RecordingError, match="is not a log"):
        load_transitions(path, MODEL)
    with pytest.raises(UsageError, match="a CSV has no epochs"):
        load_transitions(table(tmp_path, ["0,0,0,0,0,0,0"]), MODEL, epoch=1)


def test_a_log_cut_anywhere_gives_a_beginning_of_its_samples_or_one_clear_line(tmp_path: Path) -> None:
    whole = log(tmp_path, [sample(i) for i in range(40)] + [finished(1, 40)]).read_bytes()
    cut = tmp_path / "cut.mcap"
    for end in range(0, len(whole), 97):
        cut.write_bytes(whole[:end])
        try:
            tr = load_transitions(cut, MODEL)
        except RecordingError as error:
            told = str(error)
        else:
            told = tr.doubt
            assert not tr.independent or len(tr.x0) == 40
        assert "\n" not in told


def test_a_damaged_log_is_refused(tmp_path: Path) -> None:
    path = log(tmp_path, list(itertools.chain((sample(i) for i in range(40)), [finished(1, 40)])))
    data = bytearray(path.read_bytes())
    data[len(data) // 2] ^= 1
    path.write_bytes(bytes(data))
    with pytest.raises(RecordingError):
        load_transitions(path, MODEL)


def test_two_observations_at_rest_before_each_sample_show_the_noise() -> None:
    rng = np.random.default_rng(7)
    sigma = np.array([0.001, 0.002, 0.01])

    def noisy(i: int) -> SampleTaken:
        x0, before = (np.array([0.0, 1.0, math.pi - 0.001]) + e for e in rng.normal(size=(2, 3)) * sigma)
        around = [math.remainder(x[2], 2 * math.pi) for x in (x0, before)]
        return msgspec.structs.replace(sample(i), x0=(*x0[:2].tolist(), around[0]), before=(*before[:2].tolist(), around[1]))

    samples = [noisy(i) for i in range(400)]
    found = from_samples(samples).noise
    assert found is not None
    np.testing.assert_allclose(found[:2], sigma[:2], rtol=0.25)  # a median of 400: standard error 6 %
    assert from_samples(samples[:20]).noise is None
    assert from_samples([*samples[:100], sample(100)]).noise is None


def test_a_recording_that_was_fitted_on_is_known_again_packed_reformatted_and_in_blocks(tmp_path: Path) -> None:
    rows = [f"{k * DT:.1f},{k}.0,0.0,0.0,0.1,0.5" for k in range(200)]
    original = table(tmp_path, rows, "t,x,y,theta,v,w")
    reformatted = table(tmp_path, [row.replace(".0,", ".00,") for row in rows], "t,x,y,theta,v,w", "again.csv")
    packed = tmp_path / "packed.csv.gz"
    packed.write_bytes(gzip.compress(original.read_bytes()))
    other = table(tmp_path, [*rows[:-1], rows[-1].replace("0.5", "0.6")], "t,x,y,theta,v,w", "other.csv")
    fitted = compose(ModelSpec("unicycle", DT, fitted_on=load_dataset(original, MODEL).digests))
    for path in (original, reformatted, packed):
        for tr in (load_transitions(path, fitted), blocked(load_transitions(path, fitted), 0.5, DT)):
            with pytest.raises(NotEnoughEvidence, match="fitted on this recording"):
                refuse_fitted(fitted, tr)
    with pytest.raises(NotEnoughEvidence, match="fitted on 1 of its rows"):
        refuse_fitted(fitted, load_transitions(other, fitted))
