"""Whole missions, a small share of what `make bench` repeats: false certificates within beta, good ones in time, naive versions caught."""

from __future__ import annotations

import numpy as np
import pytest
from bench_missions import Row, Watches, missions, naive, ten_controllers, vectorised_is_the_watch
from missions import Life, profile_and_settings

from s2r_runtime.evidence.bounds import clopper_pearson_upper
from s2r_runtime.evidence.watch import EProcess

SURE = 1e-3
MISSIONS, SAMPLES = 100, 1500


@pytest.mark.slow
@pytest.mark.parametrize(("rho", "change"), [(0.0, False), (0.0, True), (0.3, False), (0.98, False)])
def test_missions_issue_false_certificates_no_more_often_than_beta(rho: float, change: bool) -> None:
    row = missions(MISSIONS, SAMPLES, rho, 3, change=change)
    assert row.ok, row
    if rho == 0.0:  # and not by refusing
        assert clopper_pearson_upper(MISSIONS - row.certified, MISSIONS, SURE) <= 0.1
    if rho == 0.98:
        assert row.certified == 0


def test_ten_controllers_tried_until_one_passes_stay_within_beta() -> None:
    assert ten_controllers(MISSIONS, 4).ok


def test_the_same_missions_catch_naive_versions_and_clear_the_anytime_bound() -> None:
    rows = list(naive(400, 6000, 5))
    assert [row.planted for row in rows] == [True, False, True, True, True]
    assert all(row.ok for row in rows), rows


def test_the_vectorised_watch_is_the_watch() -> None:
    assert vectorised_is_the_watch(6).ok
    watches, one = Watches(1, 0.01), EProcess(0.01)
    for exceeds in [False] * 300 + [True] * 8:
        e = watches.update(np.array([exceeds]))[0]
        assert one.update(exceeds) == pytest.approx(e)
    assert e > 1e6


def test_a_row_breaks_a_promise_only_beyond_chance_and_a_fault_must_be_caught() -> None:
    assert Row("promise", 100, 9, 0.02, 0.05).ok
    assert not Row("promise", 100, 20, 0.08, 0.05).ok
    assert not Row("fault", 100, 9, 0.02, 0.05, planted=True).ok


def test_a_life_pays_for_every_campaign_and_attempt_in_order() -> None:
    _, model, settings = profile_and_settings()
    rng = np.random.default_rng(7)
    life = Life(settings, model, rng, {"bad": 1.0, "good": 0.0})
    assert life.end_campaign(rng.normal(size=life.begin_campaign()))
    assert (life.deploy("bad"), life.deploy("good")) == (False, True)
    memory = life.state.memory
    assert (memory.epochs, memory.attempts) == (1, 2)
    assert life.gap is not None
    life.measured(1.01 * life.installed[-1].verified_radius, 1.0, 5, 1)  # growth beyond the headroom: verified again, and paid for
    assert (life.state.memory.attempts, life.certified) == (3, True)
    life.measured(life.gap.radius, 1e3, 6, 1)
    assert (life.certified, life.gap) == (False, None)
    later = life.begin_campaign()
    assert later > settings.campaign_n
    assert life.end_campaign(rng.normal(size=later))
    assert not life.certified
    assert life.deploy("good")
    assert (life.state.memory.epochs, life.state.memory.attempts) == (2, 4)
