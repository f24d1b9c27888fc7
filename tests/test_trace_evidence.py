"""What a name rests on: the evidence for a dictionary, what chance makes of it, and what a recording could have shown."""

from dataclasses import replace

import numpy as np
import pytest
from trace_robots import DT, NOISE, ROBOTARIUM, commands, declared, drive, recordings

from s2r_runtime.models.composed import AppliedEffect, compose, wrap
from s2r_runtime.modelspec import EffectSpec, ModelSpec
from s2r_runtime.plugins import registry
from s2r_runtime.trace.data.dataset import Stream, from_arrays, from_streams
from s2r_runtime.trace.data.streams import held_between, held_means
from s2r_runtime.trace.estimation import problem as problems
from s2r_runtime.trace.estimation.noise import Noise, quantum
from s2r_runtime.trace.estimation.parameters import Added
from s2r_runtime.trace.estimation.prediction import acting, residual, steps_of
from s2r_runtime.trace.estimation.problem import evaluate, fitted, insert, problem, refine
from s2r_runtime.trace.hypotheses.basis import LINE, dictionaries, line, quieter
from s2r_runtime.trace.hypotheses.library import candidates
from s2r_runtime.trace.hypotheses.starting_values import Leftover
from s2r_runtime.trace.pipeline import trace
from s2r_runtime.trace.selection import exchange, scores
from s2r_runtime.trace.selection.evidence import RIDGES, evidence, margin
from s2r_runtime.trace.selection.scores import STRICT, Scored, limited, names
from s2r_runtime.trace.sensor_faults.detect import check


def test_the_evidence_is_the_ratio_of_two_normal_densities():
    rng = np.random.default_rng(1)
    x, z = rng.normal(size=(60, 4)), rng.normal(size=60)
    z = z + x @ np.array([1.0, -0.5, 0.0, 0.2])
    found = evidence(x.T @ x, x.T @ z)
    size = float(np.mean(np.diag(x.T @ x)))
    told = []
    for ridge in RIDGES * size:
        cov = np.eye(60) + x @ x.T / ridge
        told.append(0.5 * float(z @ z) - 0.5 * float(z @ np.linalg.solve(cov, z)) - 0.5 * float(np.linalg.slogdet(cov)[1]))
    assert found.log == pytest.approx(max(told), rel=1e-9)
    product, ridge = x.T @ x, found.ridge
    assert found.beta(x.T @ z) == pytest.approx(np.linalg.solve(product + ridge * np.eye(4), x.T @ z), rel=1e-9)
    for times in (0.5, 1.0, 7.0):
        whole = 0.5 * float(np.linalg.slogdet(np.eye(4) + product * (times / ridge))[1])
        assert found.price(times) == pytest.approx(whole, rel=1e-9)


def test_terms_that_are_one_another_cost_nothing_twice():
    """The same column twice has one direction; the other one's eigenvalue is rounding, of either sign."""
    rng = np.random.default_rng(2)
    x, z = rng.normal(size=(60, 1)), rng.normal(size=60)
    both = np.hstack([x, x])
    found = evidence(both.T @ both, both.T @ z)
    assert np.all(found.values >= 0.0)
    assert found.price(3.0) == pytest.approx(0.5 * np.log1p(3.0 * 2.0 * float(x[:, 0] @ x[:, 0]) / found.ridge), rel=1e-9)
    assert both @ found.beta(both.T @ z) == pytest.approx(
        x[:, 0] * 2.0 * float(x[:, 0] @ z) / (2.0 * float(x[:, 0] @ x[:, 0]) + found.ridge), rel=1e-9
    )


def _slow(rng, n, keep):
    """A disturbance that wanders: standard deviation 1, remembered for 1 / (1 - keep) steps."""
    e = np.zeros(n)
    for k in range(1, n):
        e[k] = keep * e[k - 1] + np.sqrt(1.0 - keep * keep) * rng.normal()
    return e


def test_noise_that_wanders_is_not_beyond_what_sliding_reaches():
    """40 recordings without structure, noise and terms both slow: at 5 nats beyond 80 slides hardly one in a hundred would be."""
    alarms = 0
    for seed in range(40):
        rng = np.random.default_rng(seed)
        terms = np.stack([_slow(rng, 500, 0.95) for _ in range(3)], axis=1)[:, None, :]
        z = 3.0 * _slow(rng, 500, 0.9)[:, None]
        assert evidence(terms[:, 0].T @ terms[:, 0], terms[:, 0].T @ z[:, 0]).log > -5.0
        alarms += margin(terms, z, np.ones_like(z), 0.0) > 5.0
    assert alarms <= 2


def test_structure_in_wandering_noise_is_beyond_what_sliding_reaches():
    for seed in range(5):
        rng = np.random.default_rng(100 + seed)
        terms = np.stack([_slow(rng, 1500, 0.9) for _ in range(3)], axis=1)[:, None, :]
        z = _slow(rng, 1500, 0.9)[:, None] + 0.8 * terms[:, :, 1]
        assert margin(terms, z, np.ones_like(z), 5.0) > 8.0


@pytest.mark.slow
def test_a_gain_well_above_the_size_that_could_be_seen_is_named():
    clean = recordings([], 1, steps=700, seed=41)[0]
    could = {(v.name, v.channel): v for v in trace(clean, declared()).could_see}
    least = could["input_gain", "w"].size
    assert 0.0 < least < 0.01
    off = recordings([("input_gain", "w", {"gain": 0.98})], 1, steps=700, seed=41)[0]
    found = trace(off, declared())
    assert ("input_gain", "w") in {(e.name, e.channel) for e in (*found.effects, *found.ambiguous_with)}


def test_inputs_that_never_change_could_not_have_shown_a_coupling_of_what_is_zero():
    u = np.zeros((1, 400, 2))
    u[0, :, 0] = 0.1
    y = drive(np.random.default_rng(3), "unicycle", u, ROBOTARIUM, DT, NOISE)
    told = trace(from_arrays(declared(), [(y[0], u[0])]), declared())
    assert told.verdict == "none"
    sizes = {(v.name, v.channel): v.size for v in told.could_see}
    assert sizes["input_gain", "w"] is None
    assert sizes["input_gain", "v"] is not None


def test_a_line_in_the_spectrum_is_found_where_it_is_and_noise_has_none():
    rng = np.random.default_rng(5)
    t = 0.05 * np.arange(900)
    wave = 0.4 * np.sin(2.0 * np.pi * 0.37 * t + 1.0)
    frequency, height = line(np.stack([rng.normal(size=900), wave + rng.normal(size=900)], axis=1), 0.05)
    assert frequency == pytest.approx(0.37, abs=0.25 / 45.0)
    assert height > LINE
    highest = [line(np.cumsum(rng.normal(size=(900, 2)), axis=0) if k % 2 else rng.normal(size=(900, 2)), 0.05)[1] for k in range(200)]
    assert sum(h > LINE for h in highest) <= 2, "neither in white noise nor in what wanders"


def test_states_are_averaged_over_the_time_in_which_noise_of_the_process_grows_to_that_of_the_measurement():
    rng = np.random.default_rng(6)
    true = np.column_stack([np.linspace(0.0, 1.0, 400), np.zeros(400)])
    measured = true + rng.normal(size=(400, 2)) * [0.01, 0.0]
    joined = np.ones(400, dtype=bool)
    joined[[0, 200]] = False
    model = compose(ModelSpec("joint", 0.1, {"mass": 1.0}))
    given = problem(data := from_arrays(model, [(np.vstack([measured, measured[-1:]]), np.zeros((400, 1)))]), steps_of(data))
    given = replace(given, steps=replace(given.steps, y0=measured, y1=measured, joined=joined))
    law, nothing = Noise(np.array([1e-6, 1e-4]), np.array([1e-4, 1e-6])), np.zeros((400, 2))
    calm = quieter(given, law, nothing)
    assert np.std(calm[20:-20, 0] - true[20:-20, 0]) < 0.01 / np.sqrt(15.0)
    assert np.array_equal(calm[:, 1], measured[:, 1]), "where measurements are better than the process there is nothing to average"
    assert np.allclose(calm[[0, 199, 200, 399]], measured[[0, 199, 200, 399]], atol=1e-12), "never across a gap"
    wave = 0.5 * np.sin(0.3 * np.arange(401))[:, None]
    turning = replace(given, steps=replace(given.steps, y0=measured + wave[:-1], y1=measured + wave[1:]))
    assert np.allclose(quieter(turning, law, nothing)[:, 0], (calm + wave[:-1])[:, 0], atol=1e-12), "by how the model moves on"


def test_a_curve_that_gave_up_one_of_its_numbers_is_not_named():
    model = compose(ModelSpec("joint", 0.01, {"mass": 1.0}))
    effect = registry().get("effects", "stribeck_friction")
    for force, named in ((0.3, True), (0.0, False)):
        added = insert(model, AppliedEffect(effect, "qd", {"force": force, "static_force": 0.5, "velocity": 0.1}), 0)
        u = np.repeat(np.random.default_rng(7).uniform(-1.0, 1.0, 40), 5)[:, None]
        x, rows = np.zeros((1, 2)), [np.zeros(2)]
        for k in range(200):
            x = added.advance(x, u[k : k + 1], u[k : k + 1])
            rows.append(x[0])
        data = from_arrays(model, [(np.array(rows), u)])
        assert limited(evaluate(problem(data, steps_of(data)), added)) is named


def test_a_model_in_a_file_of_the_user_s_own_is_traced(tmp_path):
    path = tmp_path / "cart.py"
    path.write_text(
        'STATES = ("p", "s")\nINPUTS = ("push",)\nPARAMS = {"weight": 2.0}\n\n\n'
        "def step(x, u, dt, params):\n"
        "    import numpy as np\n\n"
        '    a = u[:, 0] / params["weight"]\n'
        "    return np.stack([x[:, 0] + dt * x[:, 1] + 0.5 * dt * dt * a, x[:, 1] + dt * a], axis=1)\n"
    )
    model = compose(ModelSpec(str(path), 0.05))
    rng = np.random.default_rng(8)
    u = np.repeat(rng.uniform(-1.0, 1.0, 60), 10)[:, None]
    x, rows = np.zeros((1, 2)), [np.zeros(2)]
    for k in range(600):
        x = model.advance(x, 0.8 * u[k : k + 1], 0.8 * u[k : k + 1])
        rows.append(x[0])
    y = np.array(rows) + rng.normal(size=(601, 2)) * [0.002, 0.004]
    found = trace(from_arrays(model, [(y, u)]), model)
    assert [(e.name, e.channel) for e in found.effects] == [("input_gain", "push")]
    assert found.effects[0].parameters["gain"][0] == pytest.approx(0.8, abs=0.01)


def test_runs_that_each_begin_at_zero_are_not_asked_when_something_happened():
    model = compose(ModelSpec("double_integrator", 0.05))
    rng = np.random.default_rng(9)
    for apart, in_order in ((20.0, True), (0.0, False)):
        runs = []
        for k in range(4):
            t = apart * k + 0.05 * np.arange(200)
            runs.append((Stream(t, rng.normal(size=(200, 4))), Stream(t, rng.normal(size=(200, 2)))))
        data = from_streams(model, runs, "here")
        assert data.in_order is in_order
        asked = {c.name for c in candidates(model, data)}
        assert ("regime_change" in asked) is in_order
        assert "input_delay" in asked
        given = problem(data, steps_of(data))
        fit, act = evaluate(given, model), acting(model, data)
        tokens = {token for token, _ in dictionaries(given, model, act, fit.noise, residual(model, given.steps, act))}
        assert ({"time", "time*ax"} <= tokens) is in_order
        assert {"speed", "memory(ax)"} <= tokens


def _slowly(rng, robots, steps, dt, bounds):
    """As usual, but that the robot seldom turns, and by less in a step than a coarse compass shows."""
    u = commands(rng, robots, steps, dt, bounds)
    u[..., 1] = commands(rng, robots, steps, dt, [(-0.3, 0.3)], rest=0.6)[..., 0]
    return u


@pytest.mark.parametrize("within_a_turn", [False, True], ids=["unwrapped", "within a turn"])
def test_a_heading_that_is_rounded_coarser_than_a_step_turns_it_is_noise_and_no_spikes(within_a_turn):
    """Most rows repeat the heading of the row before: their median residual is next to nothing, and would make every turn an outlier. A
    turn is 52.36 of its steps: a heading that is rounded within one is rounded afresh where it comes round.
    """
    step = 0.12
    made = recordings([("input_gain", "w", {"gain": 0.6})], 1, steps=1500, seed=71, noise=2.0 * NOISE, inputs=_slowly)[0]
    y, u = made.runs[0].y, made.runs[0].u[:: made.substeps]
    y[:, 2] = y[:, 2] - np.mean(y[:, 2]) + np.pi
    y[:, 2] = np.rint((wrap(y[:, 2]) if within_a_turn else y[:, 2]) / step) * step
    assert np.any(np.abs(np.diff(y[:, 2])) > 6.0) == within_a_turn
    assert np.mean(np.diff(y[:, 2]) == 0.0) > 0.9
    found = check(declared(), from_arrays(declared(), [(y, u)]))
    assert not found.faults
    assert not found.outliers


@pytest.mark.slow
def test_a_robot_with_a_coarse_compass_is_traced():
    data = recordings([("input_gain", "w", {"gain": 0.6})], 1, steps=1500, seed=71, noise=2.0 * NOISE)[0]
    y = data.runs[0].y
    y[:, 2] = np.rint(y[:, 2] / 0.12) * 0.12
    found = trace(data, declared())
    assert found.outliers < 10
    assert not found.faults
    assert [(e.name, e.channel) for e in found.effects] == [("input_gain", "w")]
    assert found.effects[0].parameters["gain"][0] == pytest.approx(0.6, abs=0.06)


def test_the_step_of_rounding_is_found_or_there_is_none():
    rng = np.random.default_rng(4)
    wandering = np.cumsum(rng.normal(size=500))
    for step in (1e-9, 0.25, 1e9):
        rounded = step * np.rint(wandering / 0.25)
        assert quantum(rounded[:-1], rounded[1:]) == pytest.approx(step, rel=1e-6)
    for column in (wandering, np.zeros(500), np.full(500, np.nan), np.zeros(0), np.repeat([0.0, 1.0], 250)):
        assert quantum(column[:-1], column[1:]) == 0.0
    turning = np.cumsum(-0.03 + 1e-4 * rng.normal(size=500))  # as fast as it can
    assert quantum(turning[:-1], turning[1:]) == 0.0
    ticking = 0.0123 * np.floor(0.98 * np.arange(500))  # about one tick a step
    assert quantum(ticking[:-1], ticking[1:]) == pytest.approx(0.0123, rel=1e-6)


@pytest.mark.parametrize("begin", [0.0, 1.7e9], ids=["from zero", "since 1970"])
@pytest.mark.parametrize(("late", "row"), [(0.013, 0.1), (0.0, 0.02), (0.007, 0.02)], ids=["off the grid", "in fifths", "in fifths, late"])
def test_an_input_is_exactly_what_is_held_where_it_does_not_change_within_a_part(begin, late, row):
    """An integral of stamps since 1970 is off by a hundred thousandth of a part: every part would hold a change."""
    dt, steps, parts = 0.1, 200, 5
    t = begin + late + row * np.arange(-10, round(steps * dt / row))
    values = np.repeat(np.random.default_rng(6).uniform(-1.0, 1.0, (len(t), 2))[::10], 10, axis=0)[: len(t)]
    inputs, at = Stream(t, values), begin + dt * np.arange(steps + 1)
    apart = np.count_nonzero(np.any(np.diff(values[t > begin - row], axis=0), axis=1))
    for means in (held_means(inputs, begin, steps, dt, parts), held_between(inputs, at, parts)):
        mixed = ~np.isin(means, values).all(axis=1)
        assert np.count_nonzero(mixed) == (0 if late == 0.0 else apart)


@pytest.mark.slow
def test_what_was_searched_beside_a_model_is_known_when_it_is_searched_again(monkeypatch):
    looked_at = []
    looks = scores.screen
    monkeypatch.setattr(scores, "screen", lambda given, base, found: looked_at.append(names(base.model)) or looks(given, base, found))
    off = recordings([("input_gain", "w", {"gain": 0.8})], 1, steps=300, seed=5)[0]
    found = trace(off, declared())
    assert [e.name for e in found.effects] == ["input_gain"]
    assert len(looked_at) == len(set(looked_at)) == 2  # beside nothing, and beside the gain; what else there could be instead is known


def test_a_refinement_that_is_at_its_optimum_steps_the_model_no_more(monkeypatch):
    """Slopes were asked for where it was fitted."""
    data = recordings([("input_gain", "w", {"gain": 0.8})], 1, steps=300, seed=5)[0]
    given = problem(data, steps_of(data))
    model = insert(declared(), AppliedEffect(registry().get("effects", "input_gain"), "w", {"gain": 0.9}), len(declared().effects))
    fit = fitted(given, evaluate(given, model), model)
    stepped = []
    foretell = problems.foretold
    monkeypatch.setattr(problems, "foretold", lambda given, model: stepped.append(model) or foretell(given, model))
    assert refine(given, fit, fit.model) is fit.model
    assert not stepped
    assert (
        refine(given, fit, insert(declared(), AppliedEffect(registry().get("effects", "input_gain"), "w", {"gain": 0.9}), 1))
        is not fit.model
    )
    assert stepped, "elsewhere it is stepped, and that is seen here"


def test_an_exchange_never_takes_out_what_the_user_declared(monkeypatch):
    """Effects stand before and behind the user's own; once the first one is exchanged, the places of all others are others."""
    model = compose(ModelSpec("double_integrator", 0.05, {}, (EffectSpec("input_lag", "ax", {"time_constant": 0.2}),)))
    rng = np.random.default_rng(8)
    given_data = from_arrays(model, [(rng.normal(size=(120, 4)), rng.normal(size=(119, 2)))])
    given = problem(given_data, steps_of(given_data))

    def effect(name, channel, p):
        return AppliedEffect(registry().get("effects", name), channel, p)

    there = insert(insert(model, effect("input_gain", "ay", {"gain": 1.0}), 0), effect("input_gain", "ax", {"gain": 1.0}), 0)
    there = insert(there, effect("input_bias", "ax", {"bias": 0.0}), 3)
    asked = []

    def best(given, base, *rest):
        asked.append([(a.effect.name, a.channel) for a in base.model.effects])
        other = evaluate(given, insert(base.model, effect("input_bias", "ay", {"bias": 0.0}), len(base.model.effects)))
        return [Scored("input_bias", "ay", 1e9, replace(other, white=1e9, coloured=1e9))][: len(asked) == 1], 1

    monkeypatch.setattr(exchange, "best_candidates", best)
    after = exchange.exchanged(given, evaluate(given, there), STRICT)
    assert [a.effect.name for a in after.model.effects] == ["input_gain", "input_lag", "input_bias", "input_bias"]
    assert asked == [
        [("input_gain", "ay"), ("input_lag", "ax"), ("input_bias", "ax")],
        [("input_lag", "ax"), ("input_bias", "ax"), ("input_bias", "ay")],
    ]


def test_an_effect_on_a_state_that_asks_for_the_residual_begins_without():
    """By how much the input moves the state: there is none on that channel."""
    model = compose(ModelSpec("double_integrator", 0.05))
    data = from_arrays(model, [(np.zeros((80, 4)), np.ones((79, 2)))])
    given = problem(data, steps_of(data))
    left = Leftover(given, evaluate(given, model))
    effect = registry().get("effects", "regime_change")
    assert left.starts(effect, "vx") == []
    assert left.starts(effect, "ax")


@pytest.mark.parametrize(("pull", "flow", "verdict"), [(0.0, 0.1, "unexplained"), (0.02, 0.0, "traced")], ids=["an input", "a disturbance"])
def test_a_model_in_which_inputs_push_nowhere_is_seen_to_lack_what_they_do(tmp_path, pull, flow, verdict):
    path = tmp_path / "tank.py"
    path.write_text(
        'STATES = ("level",)\nINPUTS = ("valve",)\nPARAMS = {}\n\n\ndef step(x, u, dt, params):\n    return 0.98 * x + 0.0 * u\n'
    )
    model = compose(ModelSpec(str(path), 0.05))
    rng = np.random.default_rng(8)
    u = np.repeat(rng.uniform(-1.0, 1.0, 30), 10)[:, None]
    levels = [np.array([3.0])]
    for k in range(300):
        levels.append(0.98 * levels[-1] + flow * u[k] + pull)
    found = trace(from_arrays(model, [(np.array(levels) + 0.002 * rng.normal(size=(301, 1)), u)]), model)
    assert found.verdict == verdict
    assert ("valve" in found.depends_on) == (flow != 0.0)


def test_a_rival_that_explains_clearly_more_takes_the_place_of_what_was_found():
    late = EffectSpec("input_delay", "w", {"delay": 0.11})
    model, robot = (compose(ModelSpec("unicycle", 0.05, {}, effects)) for effects in ((), (late,)))
    rng = np.random.default_rng(0)
    u = np.repeat(rng.uniform(-1.0, 1.0, (60, 2)), 8, axis=0)
    x, hidden, rows = np.zeros((1, 3)), robot.at_rest(1), [np.zeros(3)]
    for k in range(len(u)):
        x, hidden = robot.step(x, u[k : k + 1], hidden)
        rows.append(x[0])
    data = from_arrays(model, [(np.array(rows) + rng.normal(size=(len(rows), 3)) * 0.003, u)])
    given = problem(data, steps_of(data))
    lag = AppliedEffect(registry().get("effects", "input_lag"), "w", {"time_constant": 0.1})
    nominal = evaluate(given, model)
    first = fitted(given, nominal, insert(model, lag, 0))
    found, rivals = exchange.overtaken(given, first, STRICT)
    assert [(found.model.effects[i].effect.name, found.model.effects[i].channel) for i in found.added] == [("input_delay", "w")]
    assert found.white > first.white + 10.0
    assert ("input_lag", "w") not in {(s.name, s.channel) for s in rivals}


def test_a_sine_begins_at_the_phase_that_it_has_where_noise_is_of_the_sensors():
    """Whitened, a push that lasts is felt ever more: a sine in the residual lags behind by up to a quarter of a turn."""
    told = {"frequency": 1.145, "amplitude": 0.5, "phase": -1.5}
    model, robot = (
        compose(ModelSpec("joint", 0.1, {"mass": 1.0}, effects)) for effects in ((), (EffectSpec("periodic_disturbance", "force", told),))
    )
    rng = np.random.default_rng(0)
    u = np.repeat(rng.uniform(-1.0, 1.0, 60), 5)[:, None]
    u -= u.mean()
    x, hidden, rows = np.zeros((1, 2)), robot.at_rest(1), [np.zeros(2)]
    for k in range(len(u)):
        x, hidden = robot.step(x, u[k : k + 1], hidden)
        rows.append(x[0])
    data = from_arrays(model, [(np.array(rows) + rng.normal(size=(len(rows), 2)) * [0.01, 0.05], u)])
    given = problem(data, steps_of(data))
    first = Leftover(given, evaluate(given, model)).starts(registry().get("effects", "periodic_disturbance"), "force")[0]
    assert first["frequency"] == pytest.approx(told["frequency"], abs=0.01)
    assert first["amplitude"] == pytest.approx(told["amplitude"], rel=0.2)
    assert abs(np.angle(np.exp(1j * (first["phase"] - told["phase"])))) < 0.5


def test_a_model_less_what_stands_in_for_one_of_its_effects_is_the_model_as_given():
    model = compose(ModelSpec("unicycle", 0.05, {}, (EffectSpec("integration_scheme", "*", {"scheme": "exact"}),)))
    data = from_arrays(model, [(np.zeros((80, 3)), np.ones((79, 2)))])
    instead = next(c for c in candidates(model, data) if c.replaced >= 0)
    for other in instead.models(model):
        assert problems.without(other, instead.replaced) == model


def test_what_never_happens_takes_no_place_of_a_gain(monkeypatch):
    """A gain that changed before anything was asked is a gain, and is refused as a change: both would be gone."""
    rng = np.random.default_rng(5)
    model = compose(ModelSpec("unicycle", 0.05))
    u = np.repeat(rng.uniform(-0.5, 0.5, (40, 2)), 10, axis=0)
    y, x = [np.zeros(3)], np.zeros((1, 3))
    for row in u:
        x = model.nominal.step(x, 0.8 * row[None], 0.05, model.parameters)
        y.append(x[0] + 1e-3 * rng.normal(size=3))
    data = from_arrays(model, [(np.array(y), u)])
    given = problem(data, steps_of(data))
    gains = [Added(registry().get("effects", "input_gain"), name, {"gain": 0.8}) for name in ("w", "v")]
    late = Added(registry().get("effects", "regime_change"), "w", {"time": 0.01, "gain": 0.8})
    fit = evaluate(given, replace(model, effects=tuple(gains)))
    other = evaluate(given, replace(model, effects=(gains[1], late)))
    monkeypatch.setattr(exchange, "best_candidates", lambda *asked: ([Scored("regime_change", "w", 1.0, other)], 1))
    monkeypatch.setattr(exchange, "gain", lambda one, base: 1000.0 if one is other else 0.0)
    assert exchange.exchanged(given, fit, STRICT) is fit
