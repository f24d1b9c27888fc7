"""Inputs that change within a row: a follower (a rate limit, a play) and a delay take the row's mean as what it is the mean of."""

import numpy as np
import pytest

from s2r_runtime.effects.follower import mixtures
from s2r_runtime.effects.input_backlash import InputBacklash
from s2r_runtime.models.composed import AppliedEffect, compose
from s2r_runtime.models.input_chains import Inputs
from s2r_runtime.modelspec import ModelSpec
from s2r_runtime.plugins import registry

DT, FINE, LATE = 0.01, 50, 13
"""Rows, fine rows in one, and the fine row of each in which the input changes."""

UP, DOWN = {"rate": 3.0, "rate_down": 7.0}, {"rate": 40.0}


def _held(rng, columns):
    """(T FINE, columns) in which every input is held for some rows, and changes within one."""
    made = []
    for _ in range(columns):
        values, rows = rng.uniform(-1.0, 1.0, 40), rng.integers(5, 12, 40)
        made.append(np.concatenate([np.zeros(3 * FINE + LATE), np.repeat(values, rows * FINE)]))
    end = min(map(len, made)) // FINE * FINE
    return np.stack([column[:end] for column in made], axis=1)


def _wheels():
    return compose(ModelSpec("differential_drive", DT, {"wheel_radius": 0.1, "track": 0.3}))


def _through(name, p, runs, dt, parts):
    model = _wheels()
    chain = [AppliedEffect(registry().get("effects", name), "cmd_left", p)]
    return Inputs(runs, dt, [0.0] * len(runs), parts=parts).with_ends(model, chain)


@pytest.mark.parametrize(("name", "p"), [("input_rate_limit", UP), ("input_rate_limit", DOWN), ("input_backlash", {"width": 0.3})])
@pytest.mark.parametrize("runs", [1, 6])
def test_a_change_within_a_row_is_followed_from_when_it_comes(name, p, runs):
    fine = [_held(np.random.default_rng(seed), 2) for seed in range(runs)]
    end = min(map(len, fine))
    fine = [u[:end] for u in fine]
    rows = [u.reshape(-1, FINE, 2).mean(axis=1) for u in fine]
    exact, ends = _through(name, p, fine, DT / FINE, 1)
    mean, last = _through(name, p, rows, DT, 10)
    known = np.arange(len(mean)) % (end // FINE) < end // FINE - 2  # at the end of a run nobody knows what comes
    assert mean[known] == pytest.approx(exact.reshape(-1, FINE, 2).mean(axis=1)[known], abs=1e-9)
    if name == "input_rate_limit":
        assert last[known, 0] == pytest.approx(ends[FINE - 1 :: FINE][known, 0], abs=1e-6)
    plain, _ = _through(name, p, rows, DT, 1)
    assert np.max(np.abs(plain - mean)) > 0.01  # as a row of its own it is another command


@pytest.mark.parametrize("delay", [0.0005, 0.0041, 0.01, 0.0268])
@pytest.mark.parametrize("runs", [1, 6])
def test_what_was_held_a_delay_before_the_end_of_a_row_is_what_was_commanded_before_or_after_a_change(delay, runs):
    """A mean of both would look like a lag to whoever measures a wheel's speed."""
    fine = [_held(np.random.default_rng(seed), 2) for seed in range(runs)]
    end = min(map(len, fine))
    fine = [u[:end] for u in fine]
    rows = [u.reshape(-1, FINE, 2).mean(axis=1) for u in fine]
    exact = _through("input_delay", {"delay": delay}, fine, DT / FINE, 1)[1][FINE - 1 :: FINE, 0]
    parts, alone = (_through("input_delay", {"delay": delay}, rows, DT, parts)[1][:, 0] for parts in (10, 1))
    known = np.arange(len(parts)) % (end // FINE) < end // FINE - 2
    assert parts[known] == pytest.approx(exact[known], abs=1e-9)
    assert np.max(np.abs(alone - parts)) > 0.01  # as a row of its own it is another command


@pytest.mark.parametrize(("name", "p"), [("input_delay", {"delay": 0.0005}), ("input_backlash", {"width": 0.01})])
def test_what_a_run_ends_with_does_not_depend_on_longer_runs_beside_it(name, p):
    """Nothing is known of what came after its last row, least of all that it was zero."""
    short, longer = np.ones((40, 2)), [np.ones((length, 2)) for length in range(41, 46)]
    short[-1] = 0.5
    beside, alone = (_through(name, p, runs, DT / 10, 10) for runs in ([short, *longer], [short]))
    for acts, acts_alone in zip(beside, alone, strict=True):
        assert np.array_equal(acts[:40], acts_alone)


def test_what_is_commanded_for_a_row_of_a_ramp_or_a_peak_is_a_command():
    u = np.zeros((12, 2))
    u[3:, 0] = [0.1, 0.2, 0.3, 0.4, 0.5, 0.5, 0.9, 0.5, 0.5]
    each = [_through("input_rate_limit", UP, [u], DT, parts)[0] for parts in (1, 10)]
    assert each[0] == pytest.approx(each[1], abs=1e-12)


def test_a_change_on_a_row_but_for_rounding_is_none_within_it():
    u = np.zeros((12, 2))
    u[4:, 0] = 0.3
    u[4, 0] -= 1e-12
    mean, _ = _through("input_rate_limit", UP, [u], DT, 10)
    assert not len(mixtures(u[:, 0], 12))
    u[4, 0] = 0.2
    assert mixtures(u[:, 0], 12).tolist() == [4]
    u[4, 0] = 0.3
    assert mean == pytest.approx(_through("input_rate_limit", UP, [u], DT, 1)[0], abs=1e-9)


class _Doubled(InputBacklash):
    """A play of a third party's, that goes over recordings in its own way and knows nothing of rows that are two commands."""

    name = "doubled"

    def input_sequence(self, u, model, channel, dt, p):
        return 2.0 * super().input_sequence(u, model, channel, dt, p)


def test_a_follower_that_goes_its_own_way_is_told_of_mixed_rows_only_if_it_asks():
    u = np.zeros((12, 2))
    u[4:, 0] = [0.2, *[0.3] * 7]
    model = _wheels()
    acts = [
        Inputs([u], DT, [0.0], parts=10).with_ends(model, [AppliedEffect(effect, "cmd_left", {"width": 0.1})])[0]
        for effect in (InputBacklash(), _Doubled())
    ]
    assert acts[1][:4, 0] == pytest.approx(2.0 * acts[0][:4, 0])
    assert not _Doubled.takes_mixed
    assert InputBacklash.takes_mixed
