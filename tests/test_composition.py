"""The composed statement: residuals by definition, limits that hold, an assumption that is tested, and a certificate that carries it."""

from __future__ import annotations

import math
from pathlib import Path

import msgspec
import numpy as np
import pytest
from certificate_rig import KEY, PROFILE, PUBLIC, Evidence, evidence
from numpy.typing import NDArray

from s2r_runtime.core import anytime
from s2r_runtime.core.ledger import share
from s2r_runtime.errors import ConfigError, NotEnoughEvidence
from s2r_runtime.evidence.bounds import clopper_pearson_lower
from s2r_runtime.evidence.composition import LEVEL, DrivenRun, composed, dependence, enclosure_limit, inside_runs, largest_residual, problem
from s2r_runtime.evidence.disturbance import GapSet
from s2r_runtime.evidence.statements import of_composition
from s2r_runtime.messages import Composition, Enclosure, InsideRuns
from s2r_runtime.models.composed import compose
from s2r_runtime.modelspec import EffectSpec, ModelSpec
from s2r_runtime.profile import parse_profile
from s2r_runtime.trust.certificate import load, sign

Array = NDArray[np.float64]

MODEL = compose(ModelSpec("unicycle", 0.1))
DELAYED = compose(ModelSpec("unicycle", 0.1, effects=(EffectSpec("input_delay", "*", {"delay": 0.1}),)))
GAP = GapSet("ball", (1.0, 1.0, 0.1), 0.01)


@pytest.mark.parametrize("model", [MODEL, DELAYED])
def test_the_residuals_of_a_run_are_the_disturbances_that_make_it_a_run_of_the_uncertain_model(model: object) -> None:
    rng = np.random.default_rng(4)
    chosen = MODEL if model is MODEL else DELAYED
    d = GAP.inside(rng, 50, GAP.radius)
    x, hidden, states, inputs = np.array([[0.0, 0.0, 3.1]]), chosen.at_rest(1), [], []
    for k in range(50):
        u = rng.normal(size=(1, 2))
        states.append(x[0].tolist())
        inputs.append(u[0].tolist())
        ahead, hidden = chosen.step(x, u, hidden)
        x = ahead + d[k : k + 1]
        x[:, 2] = (x[:, 2] + np.pi) % (2.0 * np.pi) - np.pi  # the robot's own convention of angles
    states.append(x[0].tolist())
    assert largest_residual(chosen, GAP, states, inputs) == pytest.approx(float(np.max(GAP.norm(d))))


def test_a_run_with_an_answer_that_is_missing_has_no_residual_that_is_known() -> None:
    states = [[0.0, 0.0, 0.0], [0.1, 0.0, 0.0], [0.2, 0.0, 0.0]]
    assert largest_residual(MODEL, GAP, states, [[1.0, 0.0], [1.0, 0.0]]) == pytest.approx(0.0, abs=1e-12)
    assert math.isinf(largest_residual(MODEL, GAP, states, [[1.0, 0.0], None]))
    assert math.isinf(largest_residual(MODEL, GAP, states[:2], [[1.0, 0.0], [1.0, 0.0]]))
    assert largest_residual(MODEL, GAP, states[:1], []) == 0.0


# ---------------------------------------------------------------- the first term


def runs(*residuals: float, controller: str = "a") -> list[DrivenRun]:
    return [DrivenRun(controller, one) for one in residuals]


def test_a_run_whose_residual_is_not_known_counts_as_outside() -> None:
    found = inside_runs(runs(0.005, 0.01, math.inf, 0.02), 0.01, beta=0.1)
    assert (found.n, found.outside, found.largest, found.own, found.controllers) == (4, 2, 0.02, 0, 1)
    assert found.upper == anytime.upper(4, 2, 0.1)
    with pytest.raises(NotEnoughEvidence, match="at least one is needed"):
        inside_runs([], 0.01, beta=0.1)


def test_where_residuals_depend_on_the_controller_its_own_runs_alone_count() -> None:
    rng = np.random.default_rng(1)
    mixed = [DrivenRun("ab"[k % 2], float(rng.random() * (1.0 + 2.0 * (k % 2)))) for k in range(200)]
    found = inside_runs(mixed, 1.5, beta=0.1, controller="a")
    assert found.refuted
    assert (found.n, found.own, found.outside, found.controllers) == (100, 100, 0, 1)
    assert found.upper == anytime.upper(100, 0, 0.05)
    alike = [DrivenRun("ab"[k % 2], float(rng.random())) for k in range(200)]
    found = inside_runs(alike, 1.5, beta=0.1, controller="c")
    assert (found.refuted, found.n, found.own, found.controllers) == (False, 200, 0, 2)
    with pytest.raises(NotEnoughEvidence, match=r"is refuted at level 0\.05"):
        inside_runs(mixed, 1.5, beta=0.1, controller="c")


def test_the_assumption_is_refuted_by_mistake_at_most_at_its_level() -> None:
    """300 lives of 150 runs by three controllers in bursts, with unknown residuals among them; the largest capital of each life."""
    rng, refuted, lives = np.random.default_rng(6), 0, 300
    for life in range(lives):
        who = np.repeat(rng.integers(0, 3, 30), 5)
        residual = np.where(rng.random(150) < 0.05, np.inf, rng.gamma(2.0, 1.0, 150))
        refuted += dependence([DrivenRun(str(c), float(r)) for c, r in zip(who, residual, strict=True)], life) >= -math.log(LEVEL)
    assert clopper_pearson_lower(refuted, lives, 1e-3) <= LEVEL


def test_a_controller_whose_residuals_are_half_as_large_again_is_found_out() -> None:
    rng, found = np.random.default_rng(7), 0
    for life in range(100):
        residual = rng.gamma(8.0, 1.0, 200) * np.where(np.arange(200) % 2, 1.5, 1.0)
        found += dependence([DrivenRun(str(k % 2), float(r)) for k, r in enumerate(residual)], life) >= -math.log(LEVEL)
    assert found >= 90


# ---------------------------------------------------------------- numbers that do not carry it


def enclosure(**changes: object) -> Enclosure:
    given = Enclosure(
        method="rate",
        rate=0.9,
        because="it was derived",
        radius=0.01,
        n=300,
        failed=3,
        upper=enclosure_limit(3, 300, 0.02),
        beta=0.02,
        seed=1,
        reach=0.05,
        rate_seen=0.88,
        controller_digest="c",
        model_digest="m",
        task_digest="t",
    )
    return msgspec.structs.replace(given, **changes)


def inside(n: int = 200, beta: float = 0.02) -> InsideRuns:
    rng = np.random.default_rng(3)
    return inside_runs([DrivenRun("ab"[k % 2], 0.009 * float(rng.random())) for k in range(n)], 0.01, beta=beta, controller="a")


def test_the_limit_is_the_sum_and_the_confidences_add() -> None:
    found = composed(enclosure(), inside())
    assert problem(found) == ""
    assert found.upper == enclosure_limit(3, 300, 0.02) + anytime.upper(200, 0, 0.01)
    text = " ".join(of_composition(found))
    for words in ("is at most", "95.99", "because it was derived", "2 controllers count, 100 of them", "not proved", "297 are enclosed"):
        assert words in text
    stranger = " ".join(of_composition(composed(enclosure(), msgspec.structs.replace(inside(), own=0))))
    assert "nothing here could test it, because it has no run of its own" in stranger
    assert "did not refute it" not in stranger
    without = composed(enclosure(method="linear", rate=0.0, because="", rate_seen=0.0), None)
    assert (without.upper, problem(without)) == (1.0, "")
    assert "nothing is claimed of the robot" in of_composition(without)[-1]


@pytest.mark.parametrize(
    ("part", "changes", "words"),
    [
        ("enclosure", {"failed": 0}, "does not follow from its counts"),
        ("enclosure", {"upper": 0.001}, "does not follow from its counts"),
        ("enclosure", {"n": 0, "failed": 0}, "out of range"),
        ("enclosure", {"rate_seen": 0.95}, "drawn states refute it"),
        ("enclosure", {"because": " "}, "has no reason"),
        ("enclosure", {"radius": 0.02}, "another radius"),
        ("runs", {"outside": 4}, "does not follow from their counts"),
        ("runs", {"upper": 0.0}, "does not follow from their counts"),
        ("runs", {"capital": 5.0}, "runs of others count"),
        ("runs", {"capital": 5.0, "refuted": True}, "runs of others count"),
        ("", {"upper": 0.001}, "is not the sum"),
    ],
)
def test_numbers_that_were_changed_do_not_carry_the_statement(part: str, changes: dict[str, object], words: str) -> None:
    found = composed(enclosure(), inside())
    changed = msgspec.structs.replace(getattr(found, part), **changes) if part else None
    wrong = msgspec.structs.replace(found, **({part: changed} if part else changes))
    assert words in problem(wrong)


# ---------------------------------------------------------------- on a certificate


def carried() -> tuple[Composition, Evidence]:
    parts = evidence()
    parts.profile = parse_profile(PROFILE.replace("[verification]", "[verification]\nrun_radius = 0.01"), "test.toml", Path())
    v = parts.verification
    digests = {"controller_digest": v.controller_digest, "model_digest": v.model_digest, "task_digest": v.task_digest}
    beta = share(parts.profile.guarantee.beta_composition, v.attempt)
    return composed(enclosure(**digests, beta=beta, upper=enclosure_limit(3, 300, beta)), inside(beta=beta)), parts


def test_a_certificate_carries_it_and_one_without_it_has_the_bytes_of_before() -> None:
    found, parts = carried()
    signed = parts.issue(composition=found)
    data = sign(signed, KEY)
    assert load(data, [PUBLIC]).composition == found
    assert [line.split(".")[0] for line in signed.shown[-3:]] == ["Residuals of runs (G13)", "Enclosure (G13)", "Composition (G13)"]
    assert any("The composed statement (G13) uses neither." in line for line in signed.not_shown)
    plain = parts.issue()
    assert b'"composition"' not in sign(plain, KEY)
    assert load(sign(plain, KEY), [PUBLIC]).composition is None
    assert not any("G13" in line for line in (*plain.shown, *plain.not_shown))


def test_no_certificate_carries_one_of_another_controller_or_with_forged_numbers() -> None:
    found, parts = carried()
    other = msgspec.structs.replace(found, enclosure=msgspec.structs.replace(found.enclosure, controller_digest="sha256:another"))
    with pytest.raises(ConfigError, match="the enclosure is of another controller, model or task"):
        parts.issue(composition=other)
    for changes, words in (({"beta": 0.04}, "more than its attempt's share"), ({"radius": 0.02}, "of another radius")):
        wrong = msgspec.structs.replace(found.enclosure, **changes)
        with pytest.raises(ConfigError, match=words):
            parts.issue(composition=msgspec.structs.replace(found, enclosure=wrong))
    with pytest.raises(NotEnoughEvidence, match="is not the sum of both"):
        parts.issue(composition=msgspec.structs.replace(found, upper=0.001))


def test_the_profile_of_before_has_the_digest_of_before() -> None:
    def profile(more: str) -> str:
        return parse_profile(PROFILE.replace("[verification]", f"[verification]\n{more}"), "test.toml", Path()).digest()

    before = parse_profile(PROFILE, "test.toml", Path()).digest()
    assert profile("run_radius = 0.0") == before != profile("run_radius = 0.01")
    with pytest.raises(ConfigError, match=r"verification.run_radius is -1.0, must be 0 \(none is meant\) or above"):
        profile("run_radius = -1.0")
