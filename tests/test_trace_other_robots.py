"""A recording of another robot than the model's is refused, or is unexplained: effects that make up for all of it are no names."""

import numpy as np
import pytest
from seeds import first

from s2r_runtime.errors import RecordingError
from s2r_runtime.models.composed import AppliedEffect, compose
from s2r_runtime.modelspec import EffectSpec, ModelSpec
from s2r_runtime.plugins import registry
from s2r_runtime.trace.checks.model_order import check_accelerations
from s2r_runtime.trace.data.dataset import from_arrays
from s2r_runtime.trace.estimation.parameters import with_values
from s2r_runtime.trace.estimation.prediction import steps_of
from s2r_runtime.trace.estimation.problem import evaluate, insert, problem
from s2r_runtime.trace.pipeline import trace
from s2r_runtime.trace.selection.lag_or_integrator import endless

DT, ROWS, FINE = 0.05, 900, 10
NOISE = np.array([0.003, 0.003, 0.005])
UNICYCLE = compose(ModelSpec("unicycle", DT))


def _held(rng, size, steps=15):
    return np.repeat(rng.uniform(-1.0, 1.0, size=(ROWS // steps, 2)) * size, steps, axis=0)


def _driven(rng, u, speeds, asked=None):
    """Where a robot gets to whose speed ahead, to the left and turning are speeds(u, those before, s). asked: as recorded, if not u."""
    x, now, dt = np.zeros((len(u) + 1, 3)), np.zeros(3), DT / FINE
    for k, now_asked in enumerate(u):
        x[k + 1] = x[k]
        for _ in range(FINE):
            now = speeds(now_asked, now, dt)
            c, s = np.cos(x[k + 1, 2]), np.sin(x[k + 1, 2])
            x[k + 1] += dt * np.array([c * now[0] - s * now[1], s * now[0] + c * now[1], now[2]])
    return from_arrays(UNICYCLE, [(x + NOISE * rng.normal(size=x.shape), u if asked is None else asked)])


def _lags(*time_constants):
    def speeds(asked, now, dt):
        return now + np.array([(asked[0] - now[0]) * dt / time_constants[0], 0.0, (asked[1] - now[2]) * dt / time_constants[1]])

    return speeds


@pytest.mark.parametrize(
    ("pushed", "said"), [((True, True), "v and w seem to be accelerations"), ((True, False), "v seems to be an acceleration")]
)
@pytest.mark.parametrize("seed", range(3))
def test_accelerations_for_speeds_are_told(pushed, said, seed):
    rng = np.random.default_rng([48, seed])

    def speeds(asked, now, dt):
        ahead, turning = (n + dt * a if grows else a for n, a, grows in zip(now[[0, 2]], asked, pushed, strict=True))
        return np.array([ahead, 0.0, turning])

    with pytest.raises(RecordingError, match=f"{said}, must be .*: so read, the model errs by"):
        trace(_driven(rng, _held(rng, [1.0, 0.5]), speeds), UNICYCLE)


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("time_constant", [0.5, 2.0, 8.0])
def test_slow_actuators_are_no_accelerations(time_constant, seed):
    rng = np.random.default_rng([49, seed])
    check_accelerations(UNICYCLE, _driven(rng, _held(rng, [1.0, 0.5]), _lags(time_constant, time_constant)))


@pytest.mark.slow
@pytest.mark.parametrize("seed", first(1, range(2)))
def test_the_speeds_of_two_wheels_are_not_those_of_a_body(seed):
    """Gains and couplings make up for it, to the last digit: they are another model."""
    rng = np.random.default_rng([50, seed])
    data = _driven(rng, _held(rng, [10.0, 10.0]), lambda u, now, dt: np.array([0.025 * (u[0] + u[1]), 0.0, 0.05 / 0.3 * (u[1] - u[0])]))
    found = trace(data, UNICYCLE)
    assert found.verdict == "unexplained"
    assert len(found.partial) > 2
    assert [e.name for e in found.spec.effects] == [e.name for e in found.partial]
    assert found.comments()[0].startswith("Partial repair")
    ends = found.to_json()["partial_error"]["rollout_rms"]
    assert all(ends[state] < 0.05 * was for state, was in found.to_json()["error"]["before"]["rollout_rms"].items())
    assert "-o MODEL.toml writes it, marked partial" in " ".join(found.text().split())


@pytest.mark.slow
@pytest.mark.parametrize("seed", first(1, range(2)))
def test_what_crosses_over_from_an_input_is_no_other_model_although_the_one_given_foretells_nothing(seed):
    """Wheels that are slow clip nearly all that is asked, and half of what is left of v comes from w."""
    rng = np.random.default_rng(seed)
    lacks = (
        EffectSpec("input_coupling", "v", {"from": "w", "coefficient": 0.3}),
        EffectSpec("wheel_saturation", "*", {"speed": 0.15, "track": 0.5}),
    )
    robot = compose(ModelSpec("unicycle", DT, {}, lacks))
    u = np.repeat(np.column_stack([rng.uniform(-1.0, 1.0, 60), rng.uniform(-2.0, 2.0, 60)]), 12, axis=0)
    x, hidden, rows = np.zeros((1, 3)), robot.at_rest(1), [np.zeros(3)]
    for asked in u:
        x, hidden = robot.step(x, asked[None], hidden)
        rows.append(x[0])
    found = trace(from_arrays(UNICYCLE, [(np.array(rows) + rng.normal(size=(len(rows), 3)) * [0.001, 0.001, 0.002], u)]), UNICYCLE)
    assert [(e.name, e.channel) for e in found.effects] == [("input_coupling", "v"), ("wheel_saturation", "*")]


def test_a_lag_that_may_be_longer_than_any_run_is_an_integral():
    rng = np.random.default_rng(53)
    data = _driven(rng, _held(rng, [1.0, 0.5]), _lags(0.5, 0.5))
    given = problem(data, steps_of(data))
    model = insert(UNICYCLE, AppliedEffect(registry().get("effects", "input_lag"), "w", {"time_constant": 20.0}), 0)
    fit = evaluate(given, model)
    (slot,) = fit.free
    lasts = len(data.runs[0].u) * DT
    assert endless(fit, lambda: {slot: (10.0, lasts + 1.0)}, data) == ("memory(w)",)
    assert endless(fit, lambda: {slot: (19.0, 21.0)}, data) == ()
    short = evaluate(given, with_values(model, fit.free, np.array([0.2 * lasts])))
    assert endless(short, lambda: pytest.fail("of a short lag no interval is asked"), data) == ()


@pytest.mark.slow
@pytest.mark.parametrize("seed", first(1, range(3)))
def test_what_an_input_does_instead_is_asked_of_the_input_and_not_of_what_is_left_of_it(seed):
    """Of a robot that goes sideways where the model turns, a deadband of w swallows all turning, and with it what goes with w."""
    rng = np.random.default_rng([51, seed])
    found = trace(_driven(rng, _held(rng, [1.0, 1.0]), lambda u, now, dt: np.array([u[0], u[1], 0.0])), UNICYCLE)
    assert found.verdict == "unexplained"
    assert not found.effects


@pytest.mark.slow
@pytest.mark.parametrize("seed", first(1, range(2)))
@pytest.mark.parametrize("late", first(1, [8, 16]))
def test_a_robot_that_answers_late_and_weakly_by_both_inputs_gets_all_its_names(late, seed):
    """As given, the model foretells nothing: the robot is elsewhere by more than it goes."""
    rng = np.random.default_rng([52, seed])
    u = _held(rng, [1.0, 1.0], 45)
    acts = np.concatenate([np.zeros((late, 2)), u[:-late]]) * [0.3, 0.4]
    found = trace(_driven(rng, acts, lambda u, now, dt: np.array([u[0], 0.0, u[1]]), asked=u), UNICYCLE)
    told = {(e.name, e.channel): e.parameters for e in found.effects}
    assert found.verdict in {"traced", "ambiguous"}
    delays = [p["delay"][0] for (name, _), p in told.items() if name == "input_delay"]  # one of both, or one of each
    assert delays
    assert delays == pytest.approx([late * DT] * len(delays), abs=0.01)
    assert [told["input_gain", name]["gain"][0] for name in ("v", "w")] == pytest.approx([0.3, 0.4], abs=0.005)


@pytest.mark.slow
@pytest.mark.parametrize("seed", first(1, range(3)))
def test_commands_on_another_clock_from_some_time_on_have_not_lost_their_effect(seed):
    """The robot goes on by what it is told, recorded 2.5 s away: no input that does nothing from then on makes it go there."""
    rng = np.random.default_rng([53, seed])
    u = _held(rng, [1.0, 1.0])
    told = np.concatenate([u[: ROWS // 2], np.roll(u[ROWS // 2 :], 50, axis=0)])
    found = trace(_driven(rng, u, lambda u, now, dt: np.array([u[0], 0.0, u[1]]), asked=told), UNICYCLE)
    assert found.verdict == "unexplained"
    assert not found.effects


@pytest.mark.slow
@pytest.mark.parametrize("seed", first(1, range(2)))
def test_a_wheel_drive_that_failed_on_the_way_is_named(seed):
    rng = np.random.default_rng([54, seed])
    u = _held(rng, [1.0, 1.0])
    acts = u * np.where(np.arange(ROWS) < ROWS // 2, 1.0, 0.0)[:, None] ** [0, 1]
    found = trace(_driven(rng, acts, lambda u, now, dt: np.array([u[0], 0.0, u[1]]), asked=u), UNICYCLE)
    assert found.verdict in {"traced", "ambiguous"}
    assert ("regime_change", "w") in {(e.name, e.channel) for e in found.effects}
