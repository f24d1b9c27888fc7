"""Faults of a position whose speed was not measured: told from its rows, before anything smooths them."""

import numpy as np
import pytest
from test_trace_friction import _joint, _recorded

from s2r_runtime.trace.data.streams import Stream
from s2r_runtime.trace.pipeline import load_dataset, trace
from s2r_runtime.trace.sensor_faults.position_outliers import mended


def _frozen(q):
    q[4000:4300] = q[4000]


def _jumped(q):
    q[5000:] += 0.02


def _spiked(q):
    q[6000] += 0.05


@pytest.mark.slow
@pytest.mark.parametrize(
    ("wrong", "kind", "begins", "ends"),
    [
        pytest.param(_frozen, "frozen", 4.0, 4.3, marks=pytest.mark.slow),
        (_jumped, "offset_jump", 5.0, 10.0),
        pytest.param(_spiked, "spike", 6.0, 6.0, marks=pytest.mark.slow),
    ],
)
def test_a_fault_of_a_position_alone_is_found_where_it_is_and_takes_no_name_away(tmp_path, wrong, kind, begins, ends):
    rows = _recorded(np.random.default_rng(0), 10.0)
    wrong(rows[:, 1])
    path = tmp_path / "joint.csv"
    np.savetxt(path, rows, delimiter=",", header="t,q,force", comments="", fmt="%.8g")
    model = _joint()
    found = trace(load_dataset(path, model), model)
    (fault,) = found.faults
    assert (fault.kind, fault.channel) == (kind, "q")
    assert (fault.from_s, fault.to_s) == pytest.approx((begins, ends), abs=0.01)
    assert {e.name for e in found.effects} == {"coulomb_friction", "viscous_friction"}


def _checked(p, h=0.001, pushed=0.0):
    t = h * np.arange(len(p))
    return mended(Stream(t, p[:, None]), [(0, "q")], np.full((len(p) - 1, 1), pushed), 0.0)


def test_a_blow_that_changes_the_pace_at_once_is_no_jump():
    t = 0.001 * np.arange(4000)
    p = np.where(t < 2.0, t, 2.0 - 0.5 * (t - 2.0)) + 1e-5 * np.random.default_rng(1).normal(size=4000)
    assert _checked(p).faults == ()


@pytest.mark.parametrize("into", [0.0, 0.5, 0.9], ids=["at a row", "between two", "just before one"])
@pytest.mark.parametrize("after", [-1.0, -0.6, 0.0, 2.0])
@pytest.mark.parametrize("noise", [1e-9, 1e-6])
def test_an_end_stop_or_a_blow_on_a_fine_encoder_is_no_spike(noise, after, into):
    t = 0.01 * (np.arange(1000) - 500 + into)
    p = np.where(t < 0.0, t, after * t) + noise * np.random.default_rng(2).normal(size=1000)
    assert _checked(p, 0.01).faults == ()


def test_a_spike_beside_a_blow_is_found():
    t = 0.01 * (np.arange(1000) - 500)
    p = np.where(t < 0.0, t, 0.0) + 1e-6 * np.random.default_rng(3).normal(size=1000)
    p[502] += 0.1
    assert [f.kind for f in _checked(p, 0.01).faults] == ["spike"]


def test_a_coarse_encoder_that_creeps_and_stands_is_not_frozen():
    t = 0.001 * np.arange(20_000)
    p = np.round(0.05 * np.sin(0.4 * t) / 1e-3) * 1e-3  # up to fifty rows on one count, much more where it turns
    p[8000:10_000] = p[8000]
    assert _checked(p[:10_000]).faults == ()


@pytest.mark.parametrize("seed", range(3))
def test_noise_with_wild_rows_has_no_faults(seed):
    rng = np.random.default_rng(seed)
    p = np.sin(2.0 * np.arange(3000) * 0.01) + 1e-3 * rng.standard_t(3.0, size=3000)
    assert all(f.kind == "spike" for f in _checked(p, 0.01).faults)


def test_a_push_that_may_move_as_far_within_a_row_is_no_jump():
    rng = np.random.default_rng(4)
    p = 1e-6 * rng.normal(size=1000)
    p[500:] += 1e-3
    assert len(_checked(p, 0.01, 1.0).faults) == 1
    assert _checked(p, 0.01, 10.0).faults == ()


def test_what_was_done_while_nothing_was_recorded_is_no_jump():
    t = np.concatenate([0.01 * np.arange(500), 7.0 + 0.01 * np.arange(500)])
    p = np.sin(t) + 1e-5 * np.random.default_rng(5).normal(size=1000)
    assert mended(Stream(t, p[:, None]), [(0, "q")], np.zeros((999, 1)), 0.0).faults == ()


@pytest.mark.parametrize("seed", range(3))
def test_a_position_that_repeats_while_it_turns_round_leaps_and_is_frozen(seed):
    """Its pace before and after says nothing of the way between."""
    t = 0.01 * np.arange(4000)
    p = 0.5 * np.cos(np.pi * t) + 1e-5 * np.random.default_rng(seed).normal(size=4000)
    p[1985:2035] = p[1985]
    assert [(f.kind, round(f.from_s, 2), round(f.to_s, 2)) for f in _checked(p, 0.01).faults] == [("frozen", 19.85, 20.34)]


@pytest.mark.parametrize("seed", range(3))
def test_a_position_that_stands_once_and_sets_out_again_is_not_frozen(seed):
    t = 0.01 * np.arange(4000)
    slow = np.clip(np.abs(t - 20.0) - 2.0, 0.0, None)
    p = np.sign(t - 20.0) * slow**2 / (1.0 + slow)
    noise = 1e-5 * np.random.default_rng(seed).normal(size=4000)
    p = np.where(slow == 0.0, 0.0, p + noise)
    assert _checked(p, 0.01).faults == ()


@pytest.mark.parametrize("begin", [0, 1000], ids=["at first", "once"])
def test_a_position_that_stood_on_a_clean_encoder_and_is_kicked_is_not_frozen(begin):
    rng = np.random.default_rng(0)
    t = 0.01 * np.arange(3000)
    p = np.where(t < 0.01 * begin, np.cos(np.pi * t / 10.0), np.cos(np.pi * begin / 1000.0)) + 1e-6 * rng.normal(size=3000) * (
        t < 0.01 * begin
    )
    p[begin : begin + 60] = p[begin]
    p[begin + 60 :] = p[begin] + np.cumsum(0.02 * np.exp(-0.3 * np.arange(2940 - begin)) + 1e-5 * rng.normal(size=2940 - begin))
    assert [f for f in _checked(p, 0.01, pushed=100.0).faults if f.kind == "frozen"] == []


@pytest.mark.parametrize("seed", range(3))
def test_a_position_that_froze_at_rest_and_springs_to_where_the_robot_went_meanwhile_is_frozen(seed):
    """It was held at a set point, and was sent elsewhere; it had not been on its way, and is not under way when readings come again."""
    t = 0.002 * np.arange(1500)
    p = 0.2 * np.exp(-t / 0.05) + 0.1 * np.clip((t - 2.05) / 0.1, 0.0, 1.0) + 1e-6 * np.random.default_rng(seed).normal(size=1500)
    p[1000:1100] = p[1000]
    assert [(f.kind, round(f.from_s, 3), round(f.to_s, 3)) for f in _checked(p, 0.002).faults] == [("frozen", 2.0, 2.198)]


@pytest.mark.parametrize("share", [0.02, 0.05])
def test_many_wild_positions_are_outliers_that_are_left_out_and_counted_and_cut_nothing(share):
    """Of more than a hundredth of the rows none is a fault: it is how this sensor is. Next to one another they leave no hole."""
    rng = np.random.default_rng(4)
    t = 1e-3 * np.arange(8000)
    clean = 0.1 * np.sin(2.0 * t)
    p = clean + 1e-6 * rng.normal(size=len(t))
    wild = np.flatnonzero(rng.uniform(size=len(t)) < share)
    p[wild] += rng.choice([-1.0, 1.0], len(wild)) * rng.uniform(1e-3, 1e-2, len(wild))
    done = mended(Stream(t, p[:, None]), [(0, "q")], np.zeros((len(t) - 1, 1)), 0.0)
    assert done.faults == ()
    assert len(done.parts) == 1
    assert 0.9 * len(wild) < done.outliers < 1.1 * len(wild) + 5
    kept = np.searchsorted(t, done.parts[0].t)
    assert np.mean(np.abs(done.parts[0].values[:, 0] - clean[kept]) > 1e-4) < 0.1 * share
    assert np.max(np.diff(done.parts[0].t)) < 2.5e-3 or share > 0.03


def test_wild_rows_of_one_position_leave_another_one_as_it_is():
    """Next to one another they are bridged in their own column, between rows that are right: not over a spike or a jump of another one."""
    rng = np.random.default_rng(5)
    t = 1e-3 * np.arange(8000)
    clean = np.column_stack([0.1 * np.sin(2.0 * t), 0.1 * np.cos(2.0 * t)])
    p = clean + 1e-6 * rng.normal(size=clean.shape)
    wild = np.flatnonzero(rng.uniform(size=len(t)) < 0.03)
    p[wild, 0] += rng.choice([-1.0, 1.0], len(wild)) * rng.uniform(1e-3, 1e-2, len(wild))
    for k in wild[np.flatnonzero(np.diff(wild) == 1)][:6]:  # beside rows that are bridged
        p[k - 1, 1] += 0.05
    p[5000:, 1] += 0.02
    done = mended(Stream(t, p), [(0, "a"), (1, "b")], np.zeros((len(t) - 1, 2)), 0.0)
    for part in done.parts:
        rows = np.searchsorted(t, part.t)
        assert np.max(np.abs(part.values[:, 1] - p[rows, 1])) < 1e-3


@pytest.mark.parametrize(("rate", "dt"), [(6.0, 0.02), (10.0, 0.01), (150.0, 0.001)])
def test_what_rings_for_a_while_is_no_outlier(rate, dt):
    """It is away and back within a few rows, too, again and again."""
    t = dt * np.arange(4000)
    ringing = np.where((np.arange(4000) // 250) % 8 == 0, 0.01 * np.sin(2.0 * np.pi * rate * t), 0.0)
    p = 0.1 * np.sin(0.5 * t) + ringing + 1e-6 * np.random.default_rng(2).normal(size=len(t))
    done = mended(Stream(t, p[:, None]), [(0, "q")], np.zeros((len(t) - 1, 1)), 0.0)
    assert done.outliers == 0
    assert sum(len(part.t) for part in done.parts) > 3980
