"""The tracer on the built-in robot as its data sheet describes it: what is undeclared gets its name, or an honest answer."""

import json
import math

import msgspec
import numpy as np
import pytest
from trace_robots import declared, recordings

from s2r_runtime.errors import NotEnoughEvidence, UsageError
from s2r_runtime.models.composed import compose
from s2r_runtime.modelspec import dump_model, load_model
from s2r_runtime.trace.data.dataset import from_arrays
from s2r_runtime.trace.pipeline import trace

SETS, STEPS = 2, 600


def _names(found):
    return {(e.name, e.channel) for e in found}


UNDECLARED = {
    "gain": [("input_gain", "w", {"gain": 0.75})],
    "bias": [("input_bias", "w", {"bias": 0.1})],
    "lag": [("input_lag", "w", {"time_constant": 0.1})],
    "lag in v": [("input_lag", "v", {"time_constant": 0.2})],
    "delay": [("input_delay", "w", {"delay": 0.066})],
    "saturation": [("input_saturation", "w", {"low": -1.5, "high": 1.5})],
    "gain and lag": [("input_gain", "w", {"gain": 0.8}), ("input_lag", "w", {"time_constant": 0.1})],
    "saturation and lag": [("input_saturation", "w", {"low": -1.5, "high": 1.5}), ("input_lag", "w", {"time_constant": 0.15})],
}


@pytest.fixture(scope="module")
def traced():
    """name -> results, all sets of it."""
    return {
        name: [trace(data, declared()) for data in recordings(effects, SETS, steps=STEPS, seed=7)] for name, effects in UNDECLARED.items()
    }


@pytest.mark.slow
def test_nine_of_ten_undeclared_effects_get_their_names(traced):
    right = [_names(r.effects) == _names_of(name) and r.verdict == "traced" for name, results in traced.items() for r in results]
    assert sum(right) >= 0.9 * len(right), {name: [(r.verdict, _names(r.effects)) for r in found] for name, found in traced.items()}


def _names_of(name):
    return {(effect, channel) for effect, channel, _ in UNDECLARED[name]}


@pytest.mark.slow
def test_intervals_hold_the_true_values_as_often_as_they_say(traced):
    """95 % of n: fewer than the 0.1 % quantile of the binomial would be no chance."""
    inside = []
    for name, results in traced.items():
        truth = {(effect, channel, p): value for effect, channel, values in UNDECLARED[name] for p, value in values.items()}
        for result in results:
            for effect in result.effects:
                for p, (_, low, high, _) in effect.parameters.items():
                    if (effect.name, effect.channel, p) in truth:
                        inside.append(low <= truth[effect.name, effect.channel, p] <= high)
    n = len(inside)
    tail, least = 0.0, 0
    while tail < 1e-3:
        tail += math.comb(n, least) * 0.95**least * 0.05 ** (n - least)
        least += 1
    assert sum(inside) >= least - 1


@pytest.mark.slow
def test_the_repaired_model_foretells_what_the_fit_never_saw_down_to_noise(traced):
    for results in traced.values():
        for r in results:
            error = r.to_json()["error"]
            for state, floor in error["rollout_noise_floor"].items():
                assert error["after"]["rollout_rms"][state] < 1.3 * floor
                assert error["after"]["rollout_rms"][state] < 1.05 * error["before"]["rollout_rms"][state]


@pytest.mark.slow
def test_an_effect_before_the_declared_limit_is_told_from_one_behind_it():
    gain = ("input_gain", "w", {"gain": 0.6})
    for where, place in (("before", 0), ("behind", 2)):
        data = recordings([gain] if where == "behind" else [], 1, steps=STEPS, seed=3, before=[gain] if where == "before" else ())[0]
        found = trace(data, declared())
        assert _names(found.effects) == {("input_gain", "w")}
        order = [e.name for e in found.spec.effects if e.name in {"input_gain", "wheel_saturation"}]
        assert order == (["input_gain", "wheel_saturation"] if place == 0 else ["wheel_saturation", "input_gain"])


def test_the_answer_is_the_same_each_time_and_plain_json(traced):
    data = recordings(UNDECLARED["gain and lag"], 1, steps=STEPS, seed=33)[0]
    first, second = (trace(data, declared(), seed=5).to_json() for _ in range(2))
    assert first == second
    assert json.loads(msgspec.json.encode(first)) == first
    assert set(first) >= {
        "verdict", "effects", "candidates", "ambiguous_with", "depends_on", "suggested_excitation", "error", "gap", "faults",
        "n_fit", "n_test",
    }  # fmt: skip
    assert math.isfinite(first["gap"]["after"]["radius"])
    assert first["gap"]["after"]["radius"] < first["gap"]["before"]["radius"]


@pytest.mark.slow
def test_the_repaired_model_is_one_that_every_verb_takes(tmp_path, traced):
    result = traced["gain"][0]
    path = tmp_path / "model.toml"
    path.write_text(dump_model(result.spec, result.comments()))
    assert load_model(path) == result.spec
    assert [e.name for e in result.spec.effects] == ["input_delay", "wheel_saturation", "integration_scheme", "input_gain"]
    model = compose(result.spec)
    x, _ = model.step(np.zeros((1, 3)), np.zeros((1, 2)), model.at_rest(1))
    assert np.allclose(x, 0.0)


@pytest.mark.slow
def test_tracing_the_repaired_model_finds_nothing_more():
    data = recordings(UNDECLARED["saturation"], 2, steps=STEPS, seed=34)
    repaired = compose(trace(data[0], declared()).spec)
    assert trace(data[1], repaired).verdict == "none"


def test_another_recording_can_be_the_judge():
    fit, test = recordings(UNDECLARED["lag"], 2, steps=600, seed=35)
    found = trace(fit, declared(), test=test)
    assert _names(found.effects) == {("input_lag", "w")}
    assert found.to_json()["n_fit"] == 600
    assert found.to_json()["n_test"] == 600


def test_too_few_transitions_say_how_many_more():
    data = recordings([], 1, steps=40, seed=1)[0]
    with pytest.raises(NotEnoughEvidence, match="40 usable transitions") as refused:
        trace(data, declared())
    assert refused.value.missing == 20


def test_a_robot_that_was_never_asked_to_move_shows_nothing():
    y = np.random.default_rng(1).normal(size=(401, 3)) * 1e-3
    with pytest.raises(NotEnoughEvidence, match="every input is zero"):
        trace(from_arrays(declared(), [(y, np.zeros((400, 2)))]), declared())


def test_a_dataset_of_another_model_is_refused():
    with pytest.raises(UsageError, match=r"dt 0.033 s; the model has"):
        trace(recordings([], 1, steps=100, seed=1)[0], declared(0.1))


@pytest.mark.slow
def test_the_account_and_the_plots_say_what_was_found(traced):
    result = traced["gain"][0]
    text = result.text()
    assert text.startswith("traced: ")
    assert "input_gain on w: gain = 0.75" in text
    assert "held-out ones" in text
    plots = result.plots()
    n = len(plots["residual"]["theta"]["t"])
    assert n == len(plots["residual"]["theta"]["before"]) == len(plots["residual"]["theta"]["against"]["w"])
    after, before = (np.std(plots["residual"]["theta"][key]) for key in ("after", "before"))
    assert after < 0.5 * before
    assert plots["autocorrelation"]["theta"]["lag"][0] == 1
    assert len(plots["rollout"]["x"]["measured"]) == len(plots["rollout"]["x"]["after"])


def test_progress_is_told():
    told = []
    data = recordings(UNDECLARED["gain"], 1, steps=STEPS, seed=36)[0]
    trace(data, declared(), progress=lambda done, total, detail: told.append((done / total, detail)))
    shares = [share for share, _ in told]
    assert shares == sorted(shares)
    assert shares[0] == 0.0
    assert shares[-1] == 1.0
    assert told[-1][1] == "traced"
