"""A joint of an industrial arm as it is recorded: led along a smooth path by a controller, with what its model lacks."""

import math

import numpy as np
import pytest

from s2r_runtime.models.composed import compose
from s2r_runtime.modelspec import ModelSpec
from s2r_runtime.trace.data.dataset import from_arrays
from s2r_runtime.trace.data.readers import load_dataset
from s2r_runtime.trace.diagnostics.whole_recording import Whole
from s2r_runtime.trace.pipeline import trace
from s2r_runtime.trace.sensor_faults.detect import check

DT_S, PARTS, INERTIA = 0.004, 8, 0.8


def _path(seed, seconds, reach=1.0):
    """Eight sines: position, speed and acceleration at a time."""
    rng = np.random.default_rng(seed)
    k = np.arange(1, 9)
    phase, size, w = rng.uniform(0, 2 * np.pi, 8), rng.uniform(0.3, 1.0, 8) / k, 0.2 * np.pi * k

    def at(t):
        s, c = np.sin(w * t + phase), np.cos(w * t + phase)
        return size @ s, size @ (w * c), -size @ (w * w * s)

    most = max(abs(at(t)[0]) for t in np.linspace(0.0, seconds, 500))
    return lambda t: tuple(reach / most * float(e) for e in at(t))


def _led(seed, gravity=0.0, dry=0.0, viscous=0.0, end=math.inf, seconds=8.0, noise=0.004):
    """(q, qd) as an encoder of 17 bits and a tachometer tell them, and the torque of a controller that sees these. end: of its way, where
    it meets a stop.
    """
    rng, path, step = np.random.default_rng(seed), _path(seed, seconds), 2 * math.pi / 2**17
    (q, v, _), rows, torques, h = path(0.0), [], [], DT_S / PARTS
    for row in range(round(seconds / DT_S) + 1):
        seen, speed = round(q / step) * step, v + noise * rng.normal()
        rows.append((seen, speed))
        ahead, rate, acceleration = path(row * DT_S)
        u = INERTIA * (acceleration + 225.0 * (ahead - seen) + 24.0 * (rate - speed))
        torques.append(u)
        for _ in range(PARTS):
            back = 2000.0 * (q - math.copysign(end, q)) + 10.0 * v if abs(q) > end else 0.0
            free, stop = v + h * (u - gravity * math.sin(q) - viscous * v - back) / INERTIA, h * dry / INERTIA
            after = 0.0 if abs(free) <= stop else free - math.copysign(stop, free)
            q, v = q + 0.5 * h * (v + after), after
    return np.array(rows), np.array(torques[:-1])[:, None]


def _joint():
    return compose(ModelSpec("joint", DT_S, {"mass": INERTIA}))


@pytest.mark.parametrize("seed", [10, 11, 12])
def test_gravity_and_friction_that_hide_each_other_are_told_by_what_both_depend_on(seed):
    model = _joint()
    data = from_arrays(model, [_led(seed, gravity=4.0, dry=0.5, viscous=1.0)])
    left = Whole(check(model, data), model, horizon=125)._of_nominal()
    assert left.matters
    assert set(left.tokens) == {"position", "speed"}


@pytest.mark.slow
@pytest.mark.parametrize("seed", [1, 3, 5])
def test_an_end_stop_is_told_by_the_position_and_not_by_the_force_against_it(seed):
    model = _joint()
    data = from_arrays(model, [_led(seed, end=0.75)])
    whole = Whole(check(model, data), model, horizon=250)
    tokens = whole._of_nominal().tokens
    assert tokens[0] == "position"  # that it is met at some times only may be told besides
    assert not {"force", "memory(force)"} & {*tokens}


def _table(path, rows, torques):
    lines = [f"{k * DT_S:.3f},{q:.9g},{v:.9g},{u:.9g}" for k, ((q, v), (u,)) in enumerate(zip(rows, torques, strict=False))]
    path.write_text("\n".join(["t,q,qd,force", *lines]) + "\n")
    return path


def _late(rows, by):
    """Speeds as they were a share of a row before."""
    return np.column_stack([rows[:, 0], np.append(rows[0, 1], (1.0 - by) * rows[1:, 1] + by * rows[:-1, 1])])


def _differences(rows, bits=13):
    step = 2 * math.pi / 2**bits
    q = np.round(rows[:, 0] / step) * step
    return np.column_stack([q, np.append(rows[0, 1], np.diff(q) / DT_S)])


@pytest.mark.parametrize("measured", [lambda rows: _late(rows, 0.4), _differences], ids=["by less than a row", "of a coarse encoder"])
def test_a_speed_that_comes_late_by_a_part_of_a_row_is_no_actuator_that_answers_late(tmp_path, measured):
    rows, torques = _led(1, seconds=6.0, noise=0.0)
    model = _joint()
    data = load_dataset(_table(tmp_path / "joint.csv", measured(rows), torques), model)
    assert data.reconstruction.late["qd"] == pytest.approx(0.45 * DT_S, rel=0.3)
    assert trace(data, model).verdict == "none"


def _from_point_to_point(seed, rows=3000, still=0.0):
    """(rows, 2) of a joint that is moved and rests in turn, its speed told from its encoder by a filter; (rows, 1) torques. still: share of
    the recording after which the encoder says the same for 40 rows.
    """
    rng = np.random.default_rng(seed)
    torques = np.zeros(rows)
    for first in range(20, rows - 80, 100):
        side = rng.choice([-1.0, 1.0])
        torques[first : first + 20], torques[first + 20 : first + 40] = side * rng.uniform(0.5, 2.0) * np.array([[1.0], [-1.0]])
    a = torques / INERTIA
    v = np.append(0.0, DT_S * np.cumsum(a))[:-1]
    q = np.append(0.0, np.cumsum(DT_S * v + 0.5 * DT_S * DT_S * a))[:-1]
    q = np.round((q + 1e-5 * rng.normal(size=rows)) / 2e-5) * 2e-5
    if still:
        q[round(still * rows) : round(still * rows) + 40] = q[round(still * rows)]
    speed, told = 0.0, []
    for made in np.append(0.0, np.diff(q) / DT_S):
        speed += (made - speed) * DT_S / (DT_S + 2.0 * DT_S)
        told.append(speed)
    return np.column_stack([q, told]), torques[:, None]


@pytest.mark.slow
@pytest.mark.parametrize("still", [0.0, 0.54], ids=["as it moved", "with an encoder that stood still"])
@pytest.mark.parametrize("seed", range(2))
def test_a_filtered_speed_of_a_joint_that_rests_in_turn_is_no_actuator_that_answers_late(tmp_path, seed, still):
    """It is off, whenever the joint moves, by many times what it usually is; and where an encoder goes on, by many times that."""
    model = _joint()
    data = load_dataset(_table(tmp_path / "joint.csv", *_from_point_to_point(seed, still=still)), model)
    assert data.reconstruction.late["qd"] == pytest.approx(2.5 * DT_S, rel=0.3)
    assert still or trace(data, model).verdict == "none"


@pytest.mark.parametrize("digits", [4, 6, 9])
def test_a_simulator_whose_positions_come_early_has_speeds_that_do_not_come_late(tmp_path, digits):
    """It steps by v+ = v + h a, q+ = q + h v+, so that its speeds are the last differences of its positions."""
    _, torques = _led(1, seconds=6.0, noise=0.0)
    v = np.cumsum(np.append(0.0, DT_S * torques[:, 0] / INERTIA))
    rows = np.round(np.column_stack([np.cumsum(DT_S * v), v]), digits)
    data = load_dataset(_table(tmp_path / "joint.csv", rows, torques), _joint())
    assert data.reconstruction is None


@pytest.mark.parametrize("rows", [1, 3])
def test_an_actuator_that_is_whole_rows_late_makes_no_late_speeds_of_a_simulator_whose_positions_come_early(tmp_path, rows):
    _, torques = _led(1, seconds=6.0, noise=0.0)
    acting = np.append(np.zeros(rows), torques[:-rows, 0])
    v = np.cumsum(np.append(0.0, DT_S * acting / INERTIA))
    table = _table(tmp_path / "joint.csv", np.column_stack([np.cumsum(DT_S * v), v]), torques)
    assert load_dataset(table, _joint()).reconstruction is None
