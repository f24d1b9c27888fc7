"""The gap: what it is, what it promises (by repetition, with exact limits), and what it refuses."""

from __future__ import annotations

import math
from dataclasses import replace

import msgspec
import numpy as np
import pytest
from scipy.signal import lfilter

from s2r_runtime.errors import ConfigError, NotEnoughEvidence, UsageError
from s2r_runtime.evidence.bounds import clopper_pearson_lower, clopper_pearson_upper, sample_size, scenario_confidence
from s2r_runtime.evidence.gap import (
    blocked,
    discrepancy,
    doubted,
    estimate_gap,
    gap_json,
    noise_share,
    residuals,
    statement,
)
from s2r_runtime.evidence.whiteness import SERIAL_ALPHA, serial_p, whiteness
from s2r_runtime.messages import SERIAL
from s2r_runtime.models.composed import ComposedModel, compose
from s2r_runtime.modelspec import EffectSpec, ModelSpec
from s2r_runtime.recordings.transitions import Drive, Transitions

DT = 0.1
UNICYCLE = compose(ModelSpec("unicycle", DT))
ONES = (1.0, 1.0, 1.0)
SETTINGS = {"epsilon": 0.01, "beta": 0.05, "weights": ONES}
SURE = 1e-3
"""A repetition test may fail by chance once in a thousand."""


def states_and_inputs(rng: np.random.Generator, n: int) -> tuple[np.ndarray, np.ndarray]:
    return rng.uniform((-1, -1, -3), (1, 1, 3), (n, 3)), rng.uniform((-0.2, -2), (0.2, 2), (n, 2))


def transitions(e: np.ndarray, rng: np.random.Generator, e_hold: np.ndarray | None = None, model: ComposedModel = UNICYCLE) -> Transitions:
    """n transitions whose residuals are e (n, 3), and e_hold after 10 held periods."""
    x0, u = states_and_inputs(rng, len(e))
    x1, _ = model.step(x0, u, model.at_rest(len(e)))
    held = None if e_hold is None else model.hold(x0, u, 10) + e_hold
    return Transitions(x0, u, x1 + e, held, 1 if held is None else 10, True, {}, "sha256:0", np.arange(len(e)) * 5.0, "test")


def exponential_errors(rng: np.random.Generator, n: int) -> np.ndarray:
    """(n, 3), with norms of law Exp(1) in random directions: P[norm > r] = exp(-r)."""
    direction = rng.normal(size=(n, 3))
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    return direction * rng.exponential(size=(n, 1)) * 0.1


def violation(radius: float) -> float:
    return math.exp(-radius / 0.1)


# ---------------------------------------------------------------- what it is


def test_discrepancy_is_the_weighted_norm_of_the_set() -> None:
    e = np.array([[3.0, -4.0, 0.0], [0.0, 1.0, -2.0]])
    np.testing.assert_allclose(discrepancy(e, np.ones(3), "ball"), [5.0, math.sqrt(5.0)])
    np.testing.assert_allclose(discrepancy(e, np.ones(3), "box"), [4.0, 2.0])
    np.testing.assert_allclose(discrepancy(e, np.array([1.0, 1.0, 0.05]), "box"), [4.0, 1.0])
    np.testing.assert_allclose(discrepancy(e, np.array([1.0, 0.5, 2.0]), "ball"), [math.sqrt(13.0), math.sqrt(16.25)])


def test_a_heading_across_the_cut_is_no_full_turn() -> None:
    x0, u = np.array([[0.0, 0.0, 3.1]]), np.array([[0.0, 1.0]])
    x1 = np.array([[0.0, 0.0, -3.1]])
    tr = Transitions(x0, u, x1, None, 1, True, {}, "", np.zeros(1), "test")
    assert residuals(UNICYCLE, tr)[0, 2] == pytest.approx(2 * math.pi - 6.2 - 0.1)


@pytest.mark.parametrize("kind", ["ball", "box"])
@pytest.mark.parametrize("k", [0, 1, 5])
def test_radius_is_the_next_largest_discrepancy_after_the_discarded(kind: str, k: int) -> None:
    rng = np.random.default_rng(1)
    e = rng.normal(scale=0.01, size=(400, 3))
    w = (1.0, 1.0, 0.05)
    gap = estimate_gap(UNICYCLE, transitions(e, rng), epsilon=0.05, beta=0.05, discard=k, kind=kind, weights=w)
    by_hand = np.abs(e * w)
    norms = np.linalg.norm(by_hand, axis=1) if kind == "ball" else by_hand.max(axis=1)
    literal = np.linalg.norm(e, axis=1) if kind == "ball" else np.abs(e).max(axis=1)
    assert gap.radius == pytest.approx(sorted(norms)[-1 - k], rel=1e-9)
    assert gap.radius_literal == pytest.approx(sorted(literal)[-1 - k], rel=1e-9)
    assert (gap.n, gap.discarded, gap.set, gap.weights) == (400, k, kind, w)


def test_hold_gap_is_bounded_over_the_hold_and_takes_half_of_beta() -> None:
    rng = np.random.default_rng(2)
    e, e_hold = exponential_errors(rng, 200), exponential_errors(rng, 200)
    beta = 0.05
    enough, for_one = sample_size(0.03, beta / 2), sample_size(0.03, beta)
    assert for_one < enough < 200
    for n, periods in ((200, 10), (enough, 10), (enough - 1, 1), (for_one, 1)):
        tr = transitions(e[:n], rng, e_hold[:n])
        gap = estimate_gap(UNICYCLE, tr, epsilon=0.03, beta=beta, weights=ONES)
        assert gap.hold_periods == periods
        assert gap.hold_radius == pytest.approx(np.linalg.norm((e_hold if periods == 10 else e)[:n], axis=1).max())
        assert ("held periods" in statement(gap, True)) == (periods == 10)


@pytest.mark.slow
def test_repetition_one_shows_its_share_of_missing_coverage_and_no_more() -> None:
    """G1 with and without discards: P[V(r) > eps] is the binomial sum for a continuous law."""
    rng = np.random.default_rng(3)
    repetitions, eps, beta = 1000, 0.05, 0.05
    for k in (0, 2):
        n = sample_size(eps, beta, k)
        radii = [
            estimate_gap(UNICYCLE, transitions(exponential_errors(rng, n), rng), epsilon=eps, beta=beta, discard=k, weights=ONES).radius
            for _ in range(repetitions)
        ]
        missed = sum(violation(r) > eps for r in radii)
        assert clopper_pearson_lower(missed, repetitions, SURE) <= beta
        exact = scenario_confidence(n, k, eps)
        assert clopper_pearson_lower(missed, repetitions, SURE) <= exact <= clopper_pearson_upper(missed, repetitions, SURE)


@pytest.mark.slow
def test_gap_and_hold_gap_hold_together_with_the_confidence_stated() -> None:
    rng = np.random.default_rng(4)
    repetitions, eps, beta = 1000, 0.05, 0.1
    n = sample_size(eps, beta / 2)
    missed = 0
    for _ in range(repetitions):
        tr = transitions(exponential_errors(rng, n), rng, exponential_errors(rng, n))
        gap = estimate_gap(UNICYCLE, tr, epsilon=eps, beta=beta, weights=ONES)
        assert gap.hold_periods == 10
        missed += violation(gap.radius) > eps or violation(gap.hold_radius) > eps
    assert clopper_pearson_lower(missed, repetitions, SURE) <= beta


def test_repetition_catches_held_steps_that_are_used_as_samples() -> None:
    """The planted fault (G7): 50 steps of a hold share one error, so n samples are n / 50 draws, and the promise breaks."""
    rng = np.random.default_rng(5)
    repetitions, eps, beta = 300, 0.05, 0.05
    n = sample_size(eps, beta)
    missed = 0
    for _ in range(repetitions):
        e = np.repeat(exponential_errors(rng, -(-n // 50)), 50, axis=0)[:n]
        missed += violation(estimate_gap(UNICYCLE, transitions(e, rng), epsilon=eps, beta=beta, weights=ONES).radius) > eps
    assert clopper_pearson_lower(missed, repetitions, SURE) > beta


# ---------------------------------------------------------------- what it refuses


@pytest.mark.parametrize(("k", "needed"), [(0, 299), (1, 473)])
def test_too_few_samples_say_how_many_more(k: int, needed: int) -> None:
    rng = np.random.default_rng(6)
    tr = replace(transitions(rng.normal(size=(290, 3)), rng), rejected={"input_changed": 12})
    with pytest.raises(NotEnoughEvidence, match=rf"290 independent transitions, {needed} are needed .* {needed - 290} more") as caught:
        estimate_gap(UNICYCLE, tr, epsilon=0.01, beta=0.05, discard=k, weights=ONES)
    assert caught.value.missing == needed - 290
    assert caught.value.exit_code == 3
    assert "12 input_changed" in str(caught.value)


@pytest.mark.parametrize(
    "wrong",
    [
        {"epsilon": 0.0},
        {"epsilon": 1.0},
        {"beta": -0.1},
        {"beta": float("nan")},
        {"discard": -1},
        {"kind": "cone"},
        {"weights": (1.0, 1.0)},
        {"weights": (1.0, 1.0, 0.0)},
        {"weights": (1.0, 1.0, float("inf"))},
    ],
)
def test_settings_out_of_range_are_usage_errors(wrong: dict[str, object]) -> None:
    rng = np.random.default_rng(7)
    settings = {"epsilon": 0.05, "beta": 0.05, "weights": ONES, **wrong}
    with pytest.raises(UsageError):
        estimate_gap(UNICYCLE, transitions(rng.normal(size=(300, 3)), rng), **settings)


def test_a_model_fitted_on_a_recording_is_not_bounded_by_it() -> None:
    rng = np.random.default_rng(8)
    tr = replace(transitions(rng.normal(size=(300, 3)), rng), digest="sha256:aa", samples_digest="sha256:bb")
    for digest, refused in (("sha256:aa", True), ("sha256:bb", True), ("sha256:cc", False)):
        model = compose(msgspec.structs.replace(UNICYCLE.spec, fitted_on=(digest,)))
        if refused:
            with pytest.raises(NotEnoughEvidence, match="was fitted on this recording"):
                estimate_gap(model, tr, epsilon=0.05, beta=0.05, weights=ONES)
        else:
            estimate_gap(model, tr, epsilon=0.05, beta=0.05, weights=ONES)


def test_a_model_that_gives_nan_is_named(tmp_path) -> None:
    source = tmp_path / "broken.py"
    source.write_text(
        "STATES = ('x', 'y', 'theta')\nINPUTS = ('v', 'w')\nPARAMS = {}\ndef step(x, u, dt, params):\n    return x / 0.0 * 0\n"
    )
    model = compose(ModelSpec(str(source), DT))
    rng = np.random.default_rng(9)
    with np.errstate(all="ignore"), pytest.raises(ConfigError, match="step returned nan for state 'x' in row 0"):
        estimate_gap(model, transitions(rng.normal(size=(300, 3)), rng), epsilon=0.05, beta=0.05, weights=ONES)


# ---------------------------------------------------------------- what it says


def test_statement_gives_numbers_assumptions_and_noise() -> None:
    rng = np.random.default_rng(10)
    tr = replace(transitions(rng.normal(scale=0.01, size=(300, 3)), rng), noise=np.full(3, 0.005))
    gap = estimate_gap(UNICYCLE, tr, epsilon=0.01, beta=0.05, weights=(1.0, 1.0, 0.05))
    told = statement(gap, True, states=UNICYCLE.states)
    for part in (
        "confidence 95 %",
        "at most 1 %",
        f"r = {gap.radius:.6g}",
        "theta 0.05",
        "300 independent",
        "0 discarded",
        "95.1 %",
        "noise alone",
    ):
        assert part in told
    answer = gap_json(gap, tr, UNICYCLE.states)
    keys = {"radius", "radius_literal", "n", "discarded", "epsilon", "beta", "set", "weights", "independent", "rejected", "statement"}
    assert keys | {"hold_radius", "hold_periods", "radius_noise", "white"} <= set(answer)
    assert answer["independent"] is True
    msgspec.json.encode(answer)


def test_driving_gives_numbers_and_no_statement_until_blocks_are_vouched_for() -> None:
    rng = np.random.default_rng(11)
    e = rng.normal(scale=0.01, size=(1000, 3))
    tr = replace(
        transitions(e, rng),
        independent=False,
        doubt="ordinary driving",
        t0_s=np.arange(1000) * DT,
        drive=None,
    )
    tr = replace(tr, drive=Drive((tr.u,), np.arange(1000)))
    gap = estimate_gap(UNICYCLE, tr, epsilon=0.001, beta=0.05, weights=ONES)
    assert gap.radius == pytest.approx(np.linalg.norm(e, axis=1).max())
    assert gap_json(gap, tr, UNICYCLE.states)["independent"] is False
    assert statement(gap, False, doubt=tr.doubt).startswith("No statement: ordinary driving.")
    vouched = blocked(tr, 1.0, DT)
    assert vouched.independent
    assert len(vouched.x0) == 100
    np.testing.assert_allclose(np.diff(vouched.t0_s), 1.0)
    gap = estimate_gap(UNICYCLE, vouched, epsilon=0.03, beta=0.05, weights=ONES)
    assert gap.radius == pytest.approx(np.linalg.norm(e[::10], axis=1).max())
    assert "assumption that the user made: transitions from different blocks of 1 s" in gap_json(gap, vouched, UNICYCLE.states)["statement"]
    with pytest.raises(NotEnoughEvidence) as caught:
        estimate_gap(UNICYCLE, vouched, epsilon=0.01, beta=0.05, weights=ONES)
    assert caught.value.missing == 199


def test_blocks_must_have_a_length() -> None:
    rng = np.random.default_rng(12)
    with pytest.raises(UsageError, match="must be > 0"):
        blocked(transitions(rng.normal(size=(10, 3)), rng), 0.0, DT)


def test_blocks_are_two_steps_or_more_and_for_drives_only() -> None:
    tr = transitions(np.zeros((10, 3)), np.random.default_rng(12))
    with pytest.raises(UsageError, match=r"must be at least two steps of the model, 0\.2 s"):
        blocked(tr, 0.19, DT)
    with pytest.raises(UsageError, match="has no use here"):
        blocked(tr, 1.0, DT)


def test_noise_explains_no_more_than_all_of_the_gap() -> None:
    assert noise_share(0.3, 0.1) == "all"
    assert noise_share(0.05, 0.1) == "0.05"


def test_blocks_do_not_mend_a_campaign_that_is_not_whole() -> None:
    rng = np.random.default_rng(12)
    tr = replace(transitions(rng.normal(size=(10, 3)), rng), independent=False, doubt="the log holds 10 of the 99 samples of campaign 1")
    with pytest.raises(UsageError, match="blocking is for ordinary driving, here the log holds 10 of the 99"):
        blocked(tr, 1.0, DT)


def test_memory_of_an_effect_is_carried_along_a_drive() -> None:
    """A delayed model on a delayed robot: no residual, though inputs change at every step and some transitions were left out."""
    model = compose(ModelSpec("unicycle", DT, effects=(EffectSpec("input_delay", "*", {"delay": 0.25}),)))
    rng = np.random.default_rng(13)
    _, u = states_and_inputs(rng, 60)
    x, hidden = [np.zeros((1, 3))], model.at_rest(1)
    for row in u:
        after, hidden = model.step(x[-1], row[None, :], hidden)
        x.append(after)
    path = np.concatenate(x)
    kept = np.setdiff1d(np.arange(60), [7, 8, 30])
    tr = Transitions(path[:-1][kept], u[kept], path[1:][kept], None, 1, False, {}, "", kept * DT, "test", drive=Drive((u,), kept))
    np.testing.assert_allclose(residuals(model, tr), 0.0, atol=1e-12)
    assert np.abs(residuals(UNICYCLE, tr)).max() > 0.01


@pytest.mark.slow
def test_noise_alone_makes_what_is_said_of_it() -> None:
    """An exact model and noisy measurements: half of the campaigns have a larger radius than `radius_noise`, half a smaller one."""
    rng = np.random.default_rng(14)
    sigma, above, campaigns = np.array([0.002, 0.002, 0.01]), 0, 200
    for _ in range(campaigns):
        x0, u = states_and_inputs(rng, 60)
        x1, _ = UNICYCLE.step(x0, u, ())
        seen0, seen1 = x0 + rng.normal(size=x0.shape) * sigma, x1 + rng.normal(size=x0.shape) * sigma
        tr = Transitions(seen0, u, seen1, None, 1, True, {}, "", np.zeros(60), "test", noise=sigma)
        gap = estimate_gap(UNICYCLE, tr, epsilon=0.05, beta=0.05, weights=(1.0, 1.0, 0.05))
        assert gap.radius_noise is not None
        above += gap.radius > gap.radius_noise
    assert clopper_pearson_lower(above, campaigns, SURE) <= 0.5 <= clopper_pearson_upper(above, campaigns, SURE)


# ---------------------------------------------------------------- whiteness


@pytest.mark.slow
def test_white_noise_is_called_structured_no_more_often_than_said() -> None:
    rng = np.random.default_rng(15)
    wrong = 0
    for trial in range(3000):
        x0, u = states_and_inputs(rng, 100)
        e = rng.normal(size=(100, 3)) if trial % 2 else rng.standard_t(2.5, size=(100, 3)).round(1)
        wrong += not whiteness(UNICYCLE, x0, u, e).white
    assert clopper_pearson_lower(wrong, 3000, SURE) <= 1e-3


def lost_speed(x0: np.ndarray, u: np.ndarray) -> np.ndarray:
    """A tenth of the speed is lost: no mean in the world's axes, plain dependence on v in the body's."""
    along = -0.1 * u[:, :1] * DT
    return np.concatenate([along * np.cos(x0[:, 2:]), along * np.sin(x0[:, 2:]), np.zeros_like(along)], axis=1)


@pytest.mark.parametrize(
    ("structure", "reason"),
    [
        (lost_speed, "depends on v"),
        (lambda x0, u: np.array([0.0, 0.0, 0.002]) + 0 * x0, "the mean of the residual in theta"),
        (lambda x0, u: np.outer(np.sin(np.arange(len(x0)) / 10), [0, 0, 0.003]), "depends on the one before"),
        (lambda x0, u: np.outer(u[:, 0] * u[:, 1], [0, 0, 0.01]), "depends on v*w"),
    ],
)
def test_structure_is_found_and_named(structure, reason: str) -> None:
    rng = np.random.default_rng(16)
    x0, u = states_and_inputs(rng, 300)
    found = whiteness(UNICYCLE, x0, u, structure(x0, u) + rng.normal(scale=0.001, size=x0.shape))
    assert not found.white
    assert reason in found.reason


def test_an_exact_model_without_noise_is_white_and_too_few_samples_are_not_called_so() -> None:
    rng = np.random.default_rng(17)
    x0, u = states_and_inputs(rng, 100)
    assert whiteness(UNICYCLE, x0, u, np.zeros((100, 3))).white
    few = whiteness(UNICYCLE, x0[:20], u[:20], rng.normal(size=(20, 3)))
    assert not few.white
    assert "too few" in few.reason


def test_samples_whose_discrepancies_depend_on_each_other_carry_no_statement() -> None:
    rng = np.random.default_rng(18)
    e = np.cumsum(rng.normal(scale=0.001, size=(300, 3)), axis=0)
    tr = transitions(e, rng)
    gap = estimate_gap(UNICYCLE, tr, epsilon=0.01, beta=0.05, weights=ONES)
    assert not gap.white
    assert gap.white_reason.startswith(SERIAL)
    assert "Against the independence speaks that the error of a sample" in statement(gap, True)
    told = gap_json(gap, doubted(gap, tr), UNICYCLE.states)
    assert told["independent"] is False
    assert told["statement"].startswith("No statement: the samples were not drawn independently")
    fine = transitions(rng.permutation(e), rng)
    gap = estimate_gap(UNICYCLE, fine, epsilon=0.01, beta=0.05, weights=ONES)
    assert doubted(gap, fine) is fine


def test_residuals_of_one_size_in_an_order_of_signs_are_dependent_too() -> None:
    rng = np.random.default_rng(19)
    sign = np.where(np.arange(300) // 10 % 2, 1.0, -1.0)[:, None]
    e = sign * rng.exponential(size=(300, 1)) * np.array([[0.0, 0.0, 0.1]])  # of one size, in an order of signs
    gap = estimate_gap(UNICYCLE, transitions(e, rng), **SETTINGS)
    assert gap.white_reason.startswith(SERIAL)


@pytest.mark.parametrize("zeros", [0.0, 0.58])
def test_independent_discrepancies_are_refused_no_more_often_than_said(zeros: float) -> None:
    """58 % of them exactly 0, as where saturation hides the error; and a heavy tail."""
    rng = np.random.default_rng(20)
    campaigns = 2500
    d = np.abs(rng.standard_t(2.5, size=(campaigns, 161))) * (rng.uniform(size=(campaigns, 161)) >= zeros)
    refused = sum(serial_p(one) < SERIAL_ALPHA for one in d)
    assert clopper_pearson_lower(refused, campaigns, SURE) <= SERIAL_ALPHA


@pytest.mark.parametrize(("rho", "zeros"), [(0.98, False), (0.9, False), (0.98, True)])
def test_autoregressive_discrepancies_are_refused(rho: float, zeros: bool) -> None:
    rng = np.random.default_rng(21)
    for _ in range(20):
        z = np.abs(lfilter([math.sqrt(1 - rho * rho)], [1.0, -rho], rng.normal(size=1000)))[-161:]
        assert serial_p(np.where(z < np.quantile(z, 0.58), 0.0, z) if zeros else z) < SERIAL_ALPHA


def test_rounding_in_the_order_of_the_states_is_no_dependence() -> None:
    rng = np.random.default_rng(22)
    tr = transitions(np.full((300, 3), 0.01), rng)
    tr = replace(tr, x0=tr.x0 + np.arange(300)[:, None], x1=tr.x1 + np.arange(300)[:, None])
    gap = estimate_gap(UNICYCLE, tr, **SETTINGS)
    assert not gap.white_reason.startswith(SERIAL)


def test_few_or_equal_discrepancies_say_nothing_of_their_order() -> None:
    assert serial_p(np.zeros(500)) == 1.0
    assert serial_p(np.arange(20.0)) == 1.0
