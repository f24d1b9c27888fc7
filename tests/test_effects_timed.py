"""Effects that depend on time: it counts from the recording's first stamp, in every block and run; and what they see in a residual."""

from dataclasses import replace

import numpy as np
import pytest

from s2r_runtime.models.composed import AppliedEffect, compose
from s2r_runtime.modelspec import EffectSpec, ModelSpec
from s2r_runtime.plugins import registry
from s2r_runtime.trace.data.dataset import from_arrays
from s2r_runtime.trace.data.split import part
from s2r_runtime.trace.estimation.prediction import acting, first_steps, residual, rms, steps_of
from s2r_runtime.trace.estimation.problem import evaluate, fitted, insert, problem

DT = 0.05
TIMED = {
    "input_gain_drift": {"rate": -0.01},
    "regime_change": {"time": 31.33, "gain": 0.6},
    "periodic_disturbance": {"frequency": 0.7, "amplitude": 0.2, "phase": 1.1},
}
UNICYCLE = registry().get("models", "unicycle")


def _model(name):
    return compose(ModelSpec("unicycle", DT, {}, (EffectSpec(name, "w", TIMED[name]),)))


def _driven(model, steps, seed=0):
    """y, u of a rollout from rest at time 0."""
    rng = np.random.default_rng(seed)
    u = np.repeat(rng.uniform(-1.0, 1.0, (steps // 20, 2)), 20, axis=0)
    x, hidden, y = np.zeros((1, 3)), model.at_rest(1), [np.zeros(3)]
    for row in u:
        x, hidden = model.step(x, row[None], hidden)
        y.append(x[0])
    return np.array(y), u


@pytest.mark.parametrize("name", TIMED)
def test_a_thinned_recording_keeps_its_time(name):
    """The model that drove explains every block of a thinned recording; one that took each block for the beginning would not."""
    model = _model(name)
    data = from_arrays(model, [_driven(model, 4000)])
    thinned = part(data, (), np.ones(first_steps(data)[-1], dtype=bool), 1500)
    assert len(thinned.data.runs) >= 3
    assert np.max(np.abs(residual(model, thinned.steps, acting(model, thinned.data)))) < 1e-9
    forgotten = replace(thinned.data, runs=tuple(replace(run, start_s=0.0) for run in thinned.data.runs))
    assert rms(residual(model, steps_of(forgotten), acting(model, forgotten)))[2] > 1e-3


@pytest.mark.parametrize("name", TIMED)
def test_short_runs_side_by_side_each_know_when_they_began(name):
    model = _model(name)
    y, u = _driven(model, 1000)
    runs = [(y[k : k + 51], u[k : k + 50]) for k in range(0, 1000, 50)]
    data = from_arrays(model, runs)
    data = replace(data, runs=tuple(replace(run, start_s=k * 50 * DT) for k, run in enumerate(data.runs)))
    assert np.max(np.abs(residual(model, steps_of(data), acting(model, data)))) < 1e-9


@pytest.mark.parametrize("name", TIMED)
def test_an_effect_that_cannot_do_runs_at_once_is_taken_step_by_step_in_time(name, monkeypatch):
    model = _model(name)
    y, u = _driven(model, 1000)
    data = from_arrays(model, [(y[k : k + 51], u[k : k + 50]) for k in range(0, 1000, 50)])
    together = acting(model, data).mean
    monkeypatch.setattr(type(model.effects[0].effect), "side_by_side", False)
    assert np.allclose(acting(model, data).mean, together, rtol=1e-12, atol=1e-12)


@pytest.mark.parametrize("name", TIMED)
def test_before_the_beginning_it_is_as_at_the_beginning(name):
    effect = registry().get("effects", name)
    u = np.full((40, 2), 0.7)
    around = effect.input_sequence(u, UNICYCLE, "w", DT, TIMED[name], start=-20 * DT)
    assert np.allclose(around[:20], around[0], rtol=0.0, atol=1e-15)
    assert np.allclose(around[20:], effect.input_sequence(u[20:], UNICYCLE, "w", DT, TIMED[name]), rtol=1e-12, atol=1e-12)


def test_what_follows_a_sine_rests_at_what_it_was_before_the_start():
    sine = EffectSpec("periodic_disturbance", "w", {"frequency": 0.1, "amplitude": 0.4, "phase": 0.9})
    model = compose(ModelSpec("unicycle", DT, {}, (sine, EffectSpec("input_lag", "w", {"time_constant": 0.3}))))
    clock, lag = model.at_rest(2)
    assert np.array_equal(clock, np.zeros((2, 1)))
    assert lag[:, 0] == pytest.approx(0.4 * np.sin(0.9))


def _along(n, rng, gaps):
    """Times of steps with gaps, and where a turn pushes the pose: the heading, and noise in three states."""
    t = DT * np.sort(rng.choice(int(n * gaps), n, replace=False)) if gaps > 1.0 else DT * np.arange(n)
    pushes = np.zeros((n, 3))
    pushes[:, 2] = DT
    return t, pushes, rng.normal(size=(n, 3)) * 0.004


@pytest.mark.parametrize("gaps", [1.0, 1.5, 4.0])
@pytest.mark.parametrize("frequency", [0.05, 0.63, 4.21, 9.1])
def test_the_frequency_of_a_sine_is_found_in_the_residual(frequency, gaps):
    effect, rng = registry().get("effects", "periodic_disturbance"), np.random.default_rng(5)
    n, p = 2000, {"frequency": frequency, "amplitude": 0.05, "phase": 2.0}
    t, pushes, r = _along(n, rng, gaps)
    added = effect.input_sequence(np.zeros((round(t[-1] / DT) + 1, 2)), UNICYCLE, "w", DT, p)[np.rint(t / DT).astype(int), 1]
    r[:, 2] += DT * added
    found = effect.starts_from_residual(r, t, pushes, UNICYCLE, "w", DT)
    assert len(found) == 2
    # standard deviations of least squares: signal a sinc against noise s on n rows over a span T (Rife, Boorstyn 1974)
    a, s, span = 0.05 * np.sinc(frequency * DT) * DT, 0.004, t[-1]
    assert found[0]["frequency"] == pytest.approx(frequency, abs=5.0 * np.sqrt(6.0 / n) * s / (np.pi * span * a))
    assert found[0]["amplitude"] == pytest.approx(0.05, abs=5.0 * np.sqrt(2.0 / n) * s / a * 0.05)
    assert np.cos(found[0]["phase"] - 2.0) > np.cos(5.0 * np.sqrt(8.0 / n) * s / a)


@pytest.mark.parametrize("second", [0.0, 0.01])
def test_a_strong_sine_that_leaks_through_gaps_is_found_and_a_weak_one_beside_it(second):
    """Two runs a while apart, of each a fifth held out. The leakage of the first is far above all else, and level for a long way around."""
    effect, rng = registry().get("effects", "periodic_disturbance"), np.random.default_rng(7)
    t = DT * np.concatenate([np.arange(280), np.arange(700, 980)])
    t = t[(np.arange(560) % 280 < 84) | ((np.arange(560) % 280 >= 140) & (np.arange(560) % 280 < 224))]
    pushes = np.zeros((len(t), 3))
    pushes[:, 2] = 1.0
    r = rng.normal(size=(len(t), 3)) * 0.003
    r[:, 2] += 0.7 * np.sin(2.0 * np.pi * 2.414 * (t + DT / 2)) + second * np.sin(2.0 * np.pi * 6.2 * (t + DT / 2))
    found = effect.starts_from_residual(r, t, pushes, UNICYCLE, "w", DT)
    assert found[0]["frequency"] == pytest.approx(2.414, abs=1e-3)
    assert found[0]["amplitude"] == pytest.approx(0.7 / np.sinc(2.414 * DT), rel=0.02)
    if second:
        assert found[1]["frequency"] == pytest.approx(6.2, abs=5e-3)


def test_noise_that_grows_with_frequency_does_not_hide_a_slow_sine():
    """Noise of measured states enters a one-step residual twice: its power is all at high frequencies."""
    effect, rng = registry().get("effects", "periodic_disturbance"), np.random.default_rng(6)
    t, pushes, _ = _along(1500, rng, 1.0)
    noise = rng.normal(size=(1501, 3)) * 0.01
    r = np.diff(noise, axis=0)
    r[:, 2] += DT * 0.01 * np.sin(2.0 * np.pi * 0.4 * (t + DT / 2))
    assert effect.starts_from_residual(r, t, pushes, UNICYCLE, "w", DT)[0]["frequency"] == pytest.approx(0.4, abs=0.005)


@pytest.mark.parametrize("gaps", [1.0, 3.0])
@pytest.mark.parametrize(("share", "gain"), [(0.2, 0.7), (0.5, 1.3), (0.8, 0.5)])
def test_the_time_of_a_change_is_found_in_the_residual(share, gain, gaps):
    effect, rng = registry().get("effects", "regime_change"), np.random.default_rng(7)
    t, pushes, r = _along(2000, rng, gaps)
    u = np.repeat(rng.uniform(-1.5, 1.5, 100), 20)
    pushes *= u[:, None]
    when = float(np.quantile(t, share)) + 0.4 * DT
    r += pushes * (gain - 1.0) * (t >= when)[:, None]
    found = effect.starts_from_residual(r, t, pushes, UNICYCLE, "w", DT)
    # rows taken for the wrong side (but the one in which it comes) cost sum (gain - 1)² |pushes|² / noise², seldom beyond 20 by chance
    wrong = (t >= min(when, found[0]["time"]) + DT) & (t < max(when, found[0]["time"]))
    assert np.sum((pushes[wrong] * (gain - 1.0)) ** 2) / 0.004**2 < 20.0
    assert found[0]["gain"] == pytest.approx(gain, abs=5.0 * 0.004 / np.sqrt(np.sum(pushes[t >= when] ** 2)) + 0.01)


def test_a_change_where_nothing_was_measured_is_put_in_the_middle_of_that():
    effect, rng = registry().get("effects", "regime_change"), np.random.default_rng(7)
    t, pushes, r = _along(2000, rng, 1.0)
    pushes *= np.repeat(rng.uniform(0.5, 1.5, 100), 20)[:, None]
    r += pushes * -0.4 * (t >= 47.0)[:, None]
    seen = (t < 40.0) | (t >= 60.0)
    found = effect.starts_from_residual(r[seen], t[seen], pushes[seen], UNICYCLE, "w", DT)
    assert found[0]["time"] == pytest.approx(50.0, abs=DT)


@pytest.mark.parametrize("name", ["periodic_disturbance", "regime_change"])
def test_wild_measurements_found_nothing(name):
    effect, rng = registry().get("effects", name), np.random.default_rng(8)
    t, pushes, r = _along(1500, rng, 1.0)
    u = np.repeat(rng.uniform(-1.5, 1.5, 75), 20)
    if name == "regime_change":
        pushes *= u[:, None]
        r += pushes * -0.3 * (t >= 40.0)[:, None]
    else:
        r[:, 2] += DT * 0.05 * np.sin(2.0 * np.pi * 0.9 * (t + DT / 2))
    clean = effect.starts_from_residual(r, t, pushes, UNICYCLE, "w", DT)[0]
    r[rng.choice(1500, 15, replace=False), 2] += rng.normal(size=15) * 0.4  # a hundred standard deviations, on one row in a hundred
    spoilt = effect.starts_from_residual(r, t, pushes, UNICYCLE, "w", DT)[0]
    key = "time" if name == "regime_change" else "frequency"
    assert spoilt[key] == pytest.approx(clean[key], rel=0.02)


@pytest.mark.parametrize("name", ["periodic_disturbance", "regime_change"])
@pytest.mark.parametrize("n", [0, 1, 5, 40])
def test_a_residual_that_shows_nothing_gives_no_start_or_a_harmless_one(name, n):
    effect = registry().get("effects", name)
    for pushes in (np.zeros((n, 3)), np.ones((n, 3))):
        for p in effect.starts_from_residual(np.zeros((n, 3)), DT * np.arange(n), pushes, UNICYCLE, "w", DT):
            compose(ModelSpec("unicycle", DT, {}, (EffectSpec(name, "w", p),)))


def test_the_fit_of_a_sine_reaches_the_truth_on_a_long_recording():
    """Two runs 2400 s apart: the phase of the second turns by 15 rad for a thousandth of a hertz."""
    model, p, n = compose(ModelSpec("unicycle", DT)), {"frequency": 3.2, "amplitude": 0.2, "phase": 1.0}, 1000
    effect, rng, starts = registry().get("effects", "periodic_disturbance"), np.random.default_rng(9), (0.0, 2400.0)
    runs = []
    for start in starts:
        u = np.column_stack([np.zeros(n), np.repeat(rng.uniform(-1.0, 1.0, n // 20), 20)])
        turned = DT * np.cumsum(effect.input_sequence(u, UNICYCLE, "w", DT, p, start=start)[:, 1])
        y = np.column_stack([np.zeros((n + 1, 2)), np.append(0.0, turned)]) + rng.normal(size=(n + 1, 3)) * [0.001, 0.001, 0.003]
        runs.append((y, u))
    data = from_arrays(model, runs)
    data = replace(data, runs=tuple(replace(run, start_s=start) for run, start in zip(data.runs, starts, strict=True)))
    given = problem(data, steps_of(data))
    near = AppliedEffect(effect, "w", {"frequency": 3.2 + 2e-5, "amplitude": 0.15, "phase": 0.7})
    found = fitted(given, evaluate(given, model), insert(model, near, 0)).model.effects[0].p
    # from the difference of the two phases, each known to sqrt(2/n) noise / amplitude; the noise of a rate is blue: this is much
    s = np.sqrt(2.0 / n) * (0.003 / DT) / 0.2
    assert found["frequency"] == pytest.approx(3.2, abs=5.0 * np.sqrt(2.0) * s / (2.0 * np.pi * 2400.0))
    assert found["amplitude"] == pytest.approx(0.2, abs=5.0 * s * 0.2)


@pytest.mark.parametrize(("times", "steps"), [((1, 8, 1), (1, 8, 1)), ((8, 1), (8, 1)), ((3, 8, 1), (8, 1)), ((8, 1), ())])
def test_a_sine_before_the_start_stands_still_however_runs_share_their_times(times, steps):
    """(runs, rows, 1) inputs whose times and steps are given once for all runs: as if given for each."""
    sine, p = registry().get("effects", "periodic_disturbance"), TIMED["periodic_disturbance"]
    u, t = np.random.default_rng(3).normal(size=(3, 8, 1)), (DT * np.arange(-4.5, 3.5))[:, None]
    each = np.array([[sine.act_at(a[None], b[None], DT, p)[0] for a, b in zip(run, t, strict=True)] for run in u])
    assert np.max(np.abs(sine.act_at(u, np.broadcast_to(t, times), np.broadcast_to(DT, steps), p) - each)) < 1e-12
    assert each[:, :4] == pytest.approx(u[:, :4] + p["amplitude"] * np.sin(p["phase"]), abs=1e-12)
