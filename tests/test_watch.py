"""The watch: false alarms no more often than stated, changes found soon, and a stream that keeps its memory right."""

from __future__ import annotations

import itertools
import math
import subprocess
import sys

import numpy as np
import pytest

from s2r_runtime.evidence.bounds import clopper_pearson_lower
from s2r_runtime.evidence.watch import LARGEST, EProcess, Stream, measurement_fault
from s2r_runtime.messages import IMPLAUSIBLE, RULES, Gap, Measured, Observation, Send
from s2r_runtime.models.composed import ComposedModel, compose
from s2r_runtime.modelspec import EffectSpec, ModelSpec

SURE = 1e-3


# ---------------------------------------------------------------- the e-process


@pytest.mark.parametrize("epsilon", [0.005, 0.03, 0.3])
def test_mean_of_the_e_value_is_one_under_the_null_summed_over_all_paths(epsilon: float) -> None:
    """Exact: all 2^10 sequences, with their probabilities at P(X=1) = eps; also with a restart in the middle."""
    for restart in (None, 4):
        total = []
        for path in itertools.product((False, True), repeat=10):
            watch = EProcess(epsilon)
            for i, exceeds in enumerate(path):
                if i == restart:
                    watch = EProcess(epsilon, n=watch.n, exceedances=watch.exceedances, e_value=watch.e_value)
                watch.update(exceeds)
            total.append(watch.e_value * epsilon ** sum(path) * (1 - epsilon) ** (10 - sum(path)))
        assert math.fsum(total) == pytest.approx(1.0, rel=1e-9)


def test_false_alarms_are_no_more_frequent_than_alpha() -> None:
    """Ville: P(sup e >= 1/alpha) <= alpha; half of the runs have a quiet time before exceedances come at rate eps."""
    rng = np.random.default_rng(1)
    epsilon, alpha, runs, length = 0.05, 0.05, 400, 1500
    alarms = 0
    for run in range(runs):
        watch = EProcess(epsilon)
        rate = epsilon if run % 2 else 0.0
        for i, draw in enumerate(rng.uniform(size=length)):
            if watch.update(bool(draw < (rate if i < 300 else epsilon))) >= 1 / alpha:
                alarms += 1
                break
    assert clopper_pearson_lower(alarms, runs, SURE) <= alpha


def test_the_same_simulation_catches_a_window_that_forgets_what_it_lost() -> None:
    """The planted fault: starting anew every 50 steps, without paying for it, alarms far more often than alpha."""
    rng = np.random.default_rng(2)
    epsilon, alpha, runs, length = 0.05, 0.05, 200, 1500
    alarms = 0
    for _ in range(runs):
        for i, draw in enumerate(rng.uniform(size=length)):
            if i % 50 == 0:
                watch = EProcess(epsilon)
            if watch.update(bool(draw < epsilon)) >= 1 / alpha:
                alarms += 1
                break
    assert clopper_pearson_lower(alarms, runs, SURE) > alpha


@pytest.mark.parametrize("quiet", [0, 300, 20_000])
def test_a_change_is_found_soon_however_long_all_was_well(quiet: int) -> None:
    """Half of the transitions exceed from then on. Growth is at least 0.9 nats a step; needed are ln 100 + the price of starting late."""
    rng = np.random.default_rng(3)
    price = math.log(100) + math.log(8) + (math.log(quiet) + 2 * math.log(1 + math.log(quiet)) if quiet else 1.0)
    late = []
    for _ in range(20):
        watch = EProcess(0.03)
        for _ in range(quiet):
            watch.update(False)
        steps = 0
        while watch.e_value < 100:
            watch.update(bool(rng.uniform() < 0.5))
            steps += 1
        late.append(steps)
    assert np.median(late) <= price / 0.9 + 5


def test_a_good_robot_s_e_value_stays_small_and_finite() -> None:
    watch = EProcess(0.01)
    for _ in range(50_000):
        watch.update(False)
    assert 0.0 < watch.e_value < 1.0


def test_an_endless_run_of_exceedances_neither_overflows_nor_falls() -> None:
    watch = EProcess(1e-6)
    before = 1.0
    for _ in range(5000):
        value = watch.update(True)
        assert math.isfinite(value)
        assert value >= before
        before = value
    assert before == LARGEST
    for _ in range(100_000):
        watch.update(False)
    assert math.isfinite(watch.e_value)


def test_a_restart_goes_on_where_it_stood() -> None:
    watch = EProcess(0.03)
    for i in range(200):
        watch.update(i % 10 == 0)
    again = EProcess(0.03, n=watch.n, exceedances=watch.exceedances, e_value=watch.e_value)
    assert again.e_value == pytest.approx(watch.e_value)
    assert (again.n, again.exceedances) == (200, 20)
    assert EProcess(0.03, n=200, exceedances=20).e_value < watch.e_value


@pytest.mark.parametrize(
    "wrong", [{"epsilon": 0.0}, {"epsilon": 1.0}, {"epsilon": 0.1, "n": 3, "exceedances": 4}, {"epsilon": 0.1, "n": -1}]
)
def test_impossible_beginnings_are_refused(wrong: dict[str, float]) -> None:
    with pytest.raises(ValueError, match="must be between"):
        EProcess(**wrong)


def test_the_jump_rule_rejects_above_its_bound_and_only_where_there_is_one() -> None:
    assert measurement_fault(0.5, 0.4) == "jump"
    assert measurement_fault(0.4, 0.4) == ""
    assert measurement_fault(1e9, 0.0) == ""


def test_the_module_needs_no_numpy_to_be_imported() -> None:
    code = "import sys, s2r_runtime.evidence.watch; assert 'numpy' not in sys.modules and 'scipy' not in sys.modules"
    subprocess.run([sys.executable, "-c", code], check=True)


# ---------------------------------------------------------------- the stream

DT_NS = 33_000_000
DELAYED = compose(
    ModelSpec(
        "unicycle", 0.033, effects=(EffectSpec("input_delay", "*", {"delay": 0.05}), EffectSpec("input_lag", "v", {"time_constant": 0.1}))
    )
)


def gap(radius: float, model: ComposedModel) -> Gap:
    return Gap(radius, radius, radius, 1, "ball", (1.0, 1.0, 0.05), 99, 0, 0.03, 0.05, 1, model.spec.digest(), "sha256:0")


class Robot:
    """A robot that is exactly its model. `errors`: what is added to its state at given steps."""

    def __init__(self, model: ComposedModel, errors: dict[int, float] | None = None) -> None:
        self.model, self.errors = model, errors or {}
        self.x, self.hidden, self.k = np.zeros((1, 3)), model.at_rest(1), 0

    def observation(self) -> Observation:
        return Observation(self.k, self.k * DT_NS, tuple(self.x[0].tolist()))

    def step(self, u: tuple[float, float]) -> None:
        self.x, self.hidden = self.model.step(self.x, np.array([u]), self.hidden)
        self.k += 1
        self.x[0, 0] += self.errors.get(self.k, 0.0)


def send(k: int, u: tuple[float, float], *, obs_seq: int | None = None, t_ns: int | None = None) -> Send:
    return Send(k * DT_NS if t_ns is None else t_ns, k, "controller", u, k if obs_seq is None else obs_seq, DT_NS)


def drive(stream: Stream, robot: Robot, steps: int, lost: tuple[int, ...] = (), seed: int = 0) -> list[Measured]:
    """Random inputs; observations in `lost` do not arrive, and then nothing is sent: the robot holds what it was told."""
    rng = np.random.default_rng(seed)
    u, found = (0.0, 0.0), []
    for _ in range(steps):
        if robot.k not in lost:
            measured = stream.observed(robot.observation())
            found += [measured] if measured else []
            u = (float(rng.uniform(-0.2, 0.2)), float(rng.uniform(-2, 2)))
            stream.sent(send(robot.k, u))
        robot.step(u)
    return found


def test_each_transition_gives_one_discrepancy_named_by_the_observation_that_ended_it() -> None:
    stream = Stream(DELAYED, gap(0.01, DELAYED))
    found = drive(stream, Robot(DELAYED, {10: 0.02, 15: 0.005}), 30)
    assert [m.obs_seq for m in found] == list(range(1, 30))
    for m in found:
        assert m.discrepancy == pytest.approx({10: 0.02, 15: 0.005}.get(m.obs_seq, 0.0), abs=1e-12)
    assert (found[-1].n, found[-1].exceedances, found[-1].fault) == (29, 1, "")
    assert stream.lost == 0


def test_memory_stays_right_after_lost_observations() -> None:
    stream = Stream(DELAYED, gap(0.01, DELAYED))
    found = drive(stream, Robot(DELAYED), 60, lost=(7, 20, 21, 22, 40))
    assert max(m.discrepancy for m in found) < 1e-12
    assert stream.lost == 3
    assert {7, 8, 20, 21, 22, 23, 40, 41}.isdisjoint(m.obs_seq for m in found)
    assert len(found) == 59 - 8


def test_memory_stays_right_when_recovery_commands_are_sent_without_observations() -> None:
    """In real time the core commands by the clock while observations stay away."""
    stream, robot, rng = Stream(DELAYED, gap(0.01, DELAYED)), Robot(DELAYED), np.random.default_rng(4)
    found, last_seen = [], 0
    for k in range(60):
        blind = 20 <= k < 30
        if not blind:
            measured = stream.observed(robot.observation())
            found += [measured] if measured else []
            last_seen = k
        u = (0.0, 0.0) if blind else (float(rng.uniform(-0.2, 0.2)), float(rng.uniform(-2, 2)))
        stream.sent(send(k, u, obs_seq=last_seen))
        robot.step(u)
    assert max(m.discrepancy for m in found) < 1e-12
    assert [m.obs_seq for m in found] == [*range(1, 20), *range(31, 60)]


@pytest.mark.parametrize(("late", "ends"), [(0.15, True), (-0.009, True), (-0.02, False), (0.3, False)])
def test_only_observations_about_one_period_apart_end_a_transition(late: float, ends: bool) -> None:
    model = compose(ModelSpec("unicycle", 0.033))
    stream = Stream(model, gap(0.01, model))
    stream.observed(Observation(0, 0, (0.0, 0.0, 0.0)))
    stream.sent(send(0, (0.1, 0.0)))
    lasts = 0.033 * (1 + late)
    measured = stream.observed(Observation(1, round(1e9 * lasts), (0.1 * lasts, 0.0, 0.0)))
    assert (measured is not None) == ends
    assert stream.lost == (late > 0.2)
    if measured is not None:
        assert measured.discrepancy < 0.001 * 0.1 * 0.033 or abs(late) < 0.01


def test_a_longer_transition_is_compared_with_a_step_of_its_own_length_and_the_memory_of_what_was_commanded() -> None:
    """A lag whose time constant is two steps, after commands at uneven stamps: the closed form of its mean over the last transition."""
    tau, dt = 0.066, 0.033
    model = compose(ModelSpec("unicycle", dt, effects=(EffectSpec("input_lag", "v", {"time_constant": tau}),)))
    stream = Stream(model, gap(0.01, model))
    t, x, y, found = 0.0, 0.0, 0.0, []
    for k, (lasts, v) in enumerate([(1.0, 0.1), (1.12, 0.2), (1.05, -0.1), (1.18, 0.15), (1.0, 0.0)]):
        measured = stream.observed(Observation(k, round(t * 1e9), (x, 0.0, 0.0)))
        found += [measured.discrepancy] if measured is not None else []
        stream.sent(Send(round(t * 1e9), k, "controller", (v, 0.0), k, DT_NS))
        T = lasts * dt
        x += v * T + (y - v) * tau * (1.0 - math.exp(-T / tau))
        y = v + (y - v) * math.exp(-T / tau)
        t += T
    assert len(found) == 4
    assert max(found) < 1e-9  # stamps are rounded to a nanosecond


def test_a_command_that_another_one_replaced_at_once_leaves_no_trace_in_a_longer_transition() -> None:
    model = compose(ModelSpec("unicycle", 0.033, effects=(EffectSpec("input_lag", "v", {"time_constant": 0.066}),)))
    found = []
    for twice in (False, True):
        stream = Stream(model, gap(0.01, model))
        stream.observed(Observation(0, 0, (0.0, 0.0, 0.0)))
        if twice:
            stream.sent(Send(0, 7, "recovery", (0.2, 0.0), 0, DT_NS))
        stream.sent(Send(0, 8, "controller", (0.1, 0.0), 0, DT_NS))
        stream.observed(Observation(1, DT_NS, (0.001, 0.0, 0.0)))
        stream.sent(Send(DT_NS, 9, "controller", (0.1, 0.0), 1, DT_NS))
        measured = stream.observed(Observation(2, round(2.1 * DT_NS), (0.003, 0.0, 0.0)))
        assert measured is not None
        found.append(measured.discrepancy)
    assert math.isfinite(found[1])
    assert found[0] == pytest.approx(found[1], abs=1e-12)


def test_under_the_rules_of_before_a_transition_may_be_a_fifth_short() -> None:
    model = compose(ModelSpec("unicycle", 0.033))
    stream = Stream(model, gap(0.01, model), rules=0)
    stream.observed(Observation(0, 0, (0.0, 0.0, 0.0)))
    stream.sent(send(0, (0.1, 0.0)))
    measured = stream.observed(Observation(1, round(DT_NS * 0.85), (0.0033, 0.0, 0.0)))
    assert measured is not None
    assert measured.discrepancy < 1e-12


def test_observations_faster_than_commands_end_a_transition_when_its_period_is_over() -> None:
    model = compose(ModelSpec("unicycle", 0.04))
    stream = Stream(model, gap(0.01, model))
    found = []
    for k in range(41):  # 100 Hz, a command every 40 ms
        measured = stream.observed(Observation(k, k * 10_000_000, (0.1 * k * 0.01, 0.0, 0.0)))
        found += [measured] if measured else []
        if k % 4 == 0:
            stream.sent(Send(k * 10_000_000, k, "controller", (0.1, 0.0), k, DT_NS))
    assert [m.obs_seq for m in found] == list(range(4, 41, 4))
    assert max(m.discrepancy for m in found) < 1e-12


def test_faulty_and_repeated_observations_are_no_measurements_and_a_restarted_robot_begins_anew() -> None:
    model = compose(ModelSpec("unicycle", 0.033))
    stream = Stream(model, gap(0.01, model))
    assert stream.observed(Observation(0, 0, (0.0, 0.0, 0.0))) is None
    stream.sent(send(0, (0.1, 0.0)))
    assert stream.observed(Observation(1, DT_NS, (), "not finite")) is None
    assert stream.observed(Observation(0, 0, (0.0, 0.0, 0.0))) is None
    assert stream.observed(Observation(2, 2 * DT_NS, (0.0066, 0.0, 0.0))) is None
    assert stream.lost == 1
    stream.sent(send(2, (0.1, 0.0)))
    assert stream.observed(Observation(0, 0, (0.5, 0.0, 0.0))) is None
    stream.sent(send(0, (0.1, 0.0)))
    measured = stream.observed(Observation(1, DT_NS, (0.5033, 0.0, 0.0)))
    assert measured is not None
    assert measured.discrepancy < 1e-12


@pytest.mark.parametrize("still", [True, False], ids=["commands still act", "begins at rest"])
@pytest.mark.parametrize(
    ("effect", "blind"),
    [
        (EffectSpec("input_delay", "v", {"delay": 0.033 * 12}), range(5, 14)),
        (EffectSpec("input_lag", "v", {"time_constant": 0.15}), range(15, 25)),
        (EffectSpec("input_rate_limit", "v", {"rate": 0.5}), range(10, 20)),
        (EffectSpec("input_backlash", "v", {"width": 0.3}), range(195, 201)),
    ],
    ids=lambda given: given.name if isinstance(given, EffectSpec) else "",
)
def test_after_a_lost_link_nothing_is_measured_until_it_cannot_matter_what_still_acts(
    effect: EffectSpec, blind: range, still: bool
) -> None:
    """Four recovery commands, as the gate's hysteresis has them, then a controller. 200 commands are the longest past that counts."""
    model = compose(ModelSpec("unicycle", 0.033, effects=(effect,)))
    stream, x, hidden, found = Stream(model, gap(0.01, model)), np.zeros((1, 3)), model.at_rest(1), []
    for k in range(300):
        if k == 40:
            stream.restarted()
            stream.restarted()  # lost, and found
            hidden = hidden if still else model.at_rest(1)
        measured = stream.observed(Observation(k, k * DT_NS, tuple(map(float, x[0]))))
        found += [measured] if measured is not None else []
        recovers = 40 <= k < 44
        u = (0.0, 0.0) if recovers else (0.4 if k < 40 else 0.1, 0.3)
        stream.sent(Send(k * DT_NS, k, "recovery" if recovers else "controller", u, k, DT_NS))
        x, hidden = model.step(x, np.array([u]), hidden)
    after = [m for m in found if m.obs_seq > 40]
    assert after[0].obs_seq - 45 in blind
    assert [m.obs_seq for m in after] == list(range(after[0].obs_seq, 300))
    if effect.name != "input_backlash":
        assert max(m.discrepancy for m in found) < 0.01 * 0.4 * 0.033


def test_a_rejected_discrepancy_does_not_count_and_an_exceedance_does() -> None:
    stream = Stream(DELAYED, gap(0.01, DELAYED), fault_jump=1.0)
    found = drive(stream, Robot(DELAYED, {5: 5.0, 9: 0.5}), 12)
    by_seq = {m.obs_seq: m for m in found}
    assert by_seq[5].fault == "jump"
    assert by_seq[5].n == by_seq[4].n
    assert by_seq[5].e_value == by_seq[4].e_value
    assert (by_seq[9].fault, by_seq[9].exceedances) == ("", 1)


@pytest.mark.parametrize(("rules", "fault"), [(RULES, ""), (IMPLAUSIBLE - 1, "jump")])
def test_a_model_that_breaks_down_exceeds_the_gap_and_is_no_fault_of_measurement(rules: int, fault: str) -> None:
    model = compose(ModelSpec("unicycle", 0.033))
    stream = Stream(model, gap(0.01, model), fault_jump=20.0, rules=rules)
    stream.observed(Observation(0, 0, (1.7e308, 0.0, 0.0)))
    stream.sent(send(0, (1.7e308, 0.0)))
    with np.errstate(all="ignore"):  # as in the process that measures, where this is no error
        measured = stream.observed(Observation(1, DT_NS, (-1.7e308, 0.0, 0.0)))
    assert measured is not None
    assert (measured.fault, measured.exceedances) == (fault, 0 if fault else 1)


def test_a_stream_replayed_is_the_same_to_the_last_bit() -> None:
    first, second = (drive(Stream(DELAYED, gap(1e-13, DELAYED)), Robot(DELAYED, {3: 0.1}), 80, lost=(11,)) for _ in range(2))
    assert first == second
    assert first[-1].n > 0
