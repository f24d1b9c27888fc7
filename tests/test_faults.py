"""Faults of measurement are found where they are, and what an effect does is not taken for one."""

import numpy as np
import pytest
from trace_robots import DT, NOISE, ROBOTARIUM, commands, declared, drive, recordings

from s2r_runtime.models.composed import compose
from s2r_runtime.modelspec import EffectSpec, ModelSpec
from s2r_runtime.trace.data.dataset import Stream, from_arrays, from_streams
from s2r_runtime.trace.sensor_faults.detect import check

STEPS = 900
GAIN = (("input_gain", "v", {"gain": 0.6}), ("input_gain", "w", {"gain": 0.6}))


def _checked(spoil=None, effects=(), seed=1):
    data = recordings(effects, 1, steps=STEPS, seed=seed)[0]
    if spoil:
        spoil(data.runs[0].y)
    return check(declared(), data)


def _spike(y):
    y[500, 1] += 0.1
    y[800, 2] -= 0.5


def _step(y):
    y[400:, 0] += 0.05


def _there_and_back(y):
    y[400:600, 2] += 0.3


def _frozen(y):
    y[300:360, 2] = y[300, 2]


@pytest.mark.parametrize(
    ("spoil", "found"),
    [
        (_spike, [("spike", "y", 500, 500), ("spike", "theta", 800, 800)]),
        (_step, [("offset_jump", "x", 400, STEPS)]),
        (_there_and_back, [("offset_jump", "theta", 400, 599)]),
    ],
)
@pytest.mark.parametrize("seed", range(3))
def test_a_fault_is_reported_where_it_is(spoil, found, seed):
    checked = _checked(spoil, seed=seed)
    assert [(f.kind, f.channel, round(f.from_s / DT), round(f.to_s / DT)) for f in checked.faults] == found


def test_a_frozen_heading_is_reported_and_taken_out():
    rng = np.random.default_rng(2)
    u = commands(rng, 1, STEPS, DT, [(0.1, 0.2), (0.5, 1.0)], rest=0.0)
    y = drive(rng, "unicycle", u, ROBOTARIUM, DT, NOISE)
    _frozen(y[0])
    t = DT * np.arange(STEPS + 1)
    checked = check(declared(), from_streams(declared(), [(Stream(t, y[0]), Stream(t[:-1], u[0]))], "here"))
    (fault,) = checked.faults
    assert (fault.kind, fault.channel) == ("frozen", "theta")
    assert fault.from_s == pytest.approx(300 * DT, abs=DT)
    assert fault.to_s == pytest.approx(359 * DT, abs=DT)
    assert np.isnan(checked.data.runs[0].y[305:355]).all()


def _wheels(seed, spoil, step=0.08):
    """A differential drive whose encoders count: their speeds come in steps, and repeat."""
    rng = np.random.default_rng(seed)
    geometry = {"wheel_radius": 0.035, "track": 0.23}
    model = compose(ModelSpec("differential_drive", 0.02, geometry, (EffectSpec("integration_scheme", "*", {"scheme": "exact"}),)))
    u = commands(rng, 1, 2000, 0.02, [(-10.0, 10.0)] * 2, rest=0.1)
    wheels = np.concatenate([np.zeros((1, 2)), u[0]])
    pose = [np.zeros(3)]
    for left, right in u[0]:
        forward, turn = 0.0175 * (left + right), 0.035 * (right - left) / 0.23
        middle = pose[-1][2] + 0.5 * 0.02 * turn
        pose.append(pose[-1] + 0.02 * np.array([forward * np.cos(middle), forward * np.sin(middle), turn]))
    counted = step * np.rint((wheels + rng.uniform(-0.5, 0.5, wheels.shape) * step) / step)
    y = np.column_stack([np.array(pose) + rng.normal(size=(2001, 3)) * [0.001, 0.001, 0.002], counted])
    spoil(y, u[0])
    t = 0.02 * np.arange(2001)
    return check(model, from_streams(model, [(Stream(t, y), Stream(t[:-1], u[0]))], "here")).faults


@pytest.mark.parametrize("seed", range(4))
def test_an_encoder_that_stands_still_through_commands_is_frozen(seed):
    def freeze(y, u):
        y[750:950, 4] = y[750, 4]

    assert [(f.kind, f.channel) for f in _wheels(seed, freeze)] == [("frozen", "wheel_right")]


@pytest.mark.parametrize("seed", range(4))
def test_a_wheel_at_its_limit_or_at_rest_is_not(seed):
    def limit(y, u):
        y[:, 3:] = np.clip(y[:, 3:], -5.04, 5.04)
        y[600:800, 4] = 0.0  # held by its brake

    assert [f for f in _wheels(seed, limit) if f.kind == "frozen"] == []


@pytest.mark.parametrize(("noisy", "rest"), [(True, 0.4), (False, 0.4), (False, 0.0)])
def test_a_sensor_that_jitters_at_rest_does_not_repeat_itself_a_dozen_times(noisy, rest):
    """The robot stands for a second, now and then or once. What repeats there without noise says nothing, whatever a gain leaves."""
    rng = np.random.default_rng(6)
    u = commands(rng, 1, STEPS, DT, [(0.02, 0.2), (-1.0, 1.0)], rest=rest)
    u[0, 300:340] = 0.0
    y = drive(rng, "unicycle", u, (*ROBOTARIUM, *GAIN), DT, NOISE if noisy else 0.0 * NOISE)[0]
    y[315:330] = y[315]
    t = DT * np.arange(STEPS + 1)
    found = check(declared(), from_streams(declared(), [(Stream(t, y), Stream(t[:-1], u[0]))], "here")).faults
    if not noisy:
        assert found == ()
        return
    assert {(f.kind, f.channel) for f in found} == {("frozen", s) for s in ("x", "y", "theta")}
    assert all(abs(f.from_s / DT - 315) <= 1 and abs(f.to_s / DT - 329) <= 1 for f in found)


@pytest.mark.parametrize("seed", range(3))
def test_a_heading_that_leaves_the_motion_and_comes_back_is_found(seed):
    """0.8 rad, over 30 rows each way. The path is as straight or bent as it was: only the compass says otherwise."""
    rng = np.random.default_rng(60 + seed)
    u = commands(rng, 1, STEPS, DT, [(0.1, 0.2), (-1.0, 1.0)], rest=0.0)
    y = drive(rng, "unicycle", u, ROBOTARIUM, DT, NOISE)[0]
    off = np.interp(np.arange(STEPS + 1), [300, 330, 500, 530], [0.0, 0.8, 0.8, 0.0])
    y[:, 2] += off
    t = DT * np.arange(STEPS + 1)
    checked = check(declared(), from_streams(declared(), [(Stream(t, y), Stream(t[:-1], u[0]))], "here"))
    (fault,) = checked.faults
    assert (fault.kind, fault.channel) == ("inconsistent", "theta")
    assert fault.from_s == pytest.approx(300 * DT, abs=6 * DT)
    assert fault.to_s == pytest.approx(530 * DT, abs=6 * DT)
    assert np.isnan(checked.data.runs[0].y[off > 0.0]).all()  # also where it only begins to leave, which nothing could show yet


@pytest.mark.parametrize("seed", range(3))
def test_a_heading_that_wanders_off_and_never_comes_back_is_found(seed):
    """An IMU that drifts by 0.4 rad, and stays so for the last two fifths of the run: that is half of what a median sees."""
    rng = np.random.default_rng(80 + seed)
    u = commands(rng, 1, STEPS, DT, [(0.1, 0.2), (-1.0, 1.0)], rest=0.0)
    y = drive(rng, "unicycle", u, ROBOTARIUM, DT, 3.0 * NOISE)[0]
    y[:, 2] += np.interp(np.arange(STEPS + 1), [500, 620], [0.0, 0.4])
    t = DT * np.arange(STEPS + 1)
    (fault,) = check(declared(), from_streams(declared(), [(Stream(t, y), Stream(t[:-1], u[0]))], "here")).faults
    assert (fault.kind, fault.channel) == ("inconsistent", "theta")
    assert 490 * DT < fault.from_s < 600 * DT
    assert fault.to_s == pytest.approx(STEPS * DT, abs=2 * DT)


@pytest.mark.parametrize(
    "outside",
    [
        lambda x, v, w: (v, w, 0.05, 0.03),
        lambda x, v, w: (v, w, -0.3 * w * v * np.sin(x[:, 2]), 0.3 * w * v * np.cos(x[:, 2])),
        lambda x, v, w: (v, w + 0.3 * np.sin(x[:, 0]), 0.0, 0.0),
    ],
    ids=["wind", "sideways slip", "a yaw of its own"],
)
def test_a_robot_that_goes_another_way_than_it_points_is_no_fault(outside):
    for data in recordings([], 4, steps=STEPS, seed=70, outside=outside):
        assert check(declared(), data).faults == ()


@pytest.mark.parametrize(
    "effects",
    [
        (),
        [("input_gain", "w", {"gain": 0.4})],
        [("input_lag", "w", {"time_constant": 0.3}), ("input_lag", "v", {"time_constant": 0.3})],
        [("input_delay", "*", {"delay": 0.3})],
        [("input_saturation", "w", {"low": -0.5, "high": 0.5})],
        [("deadband", "v", {"width": 0.1})],
    ],
)
def test_what_an_effect_does_is_no_fault(effects):
    for seed in range(4):
        assert _checked(effects=effects, seed=40 + seed).faults == ()


def test_outliers_on_many_rows_are_counted_and_no_faults():
    rng = np.random.default_rng(3)

    def spoil(y):
        rows = rng.choice(len(y), 45, replace=False)
        y[rows] += rng.normal(size=(45, 3)) * [0.03, 0.03, 0.3]

    checked = _checked(spoil)
    assert checked.faults == ()
    assert 30 < checked.outliers <= 45  # rows, each of which is wild in several states


def test_outliers_that_an_input_could_have_made_are_left_out_where_tails_are_heavy():
    """Of 5 % of all values, off by 0.05 m (rad) as a rule: a step moves the robot as far as that."""
    rng = np.random.default_rng(13)
    off = np.where(rng.random((STEPS + 1, 3)) < 0.05, rng.normal(0.0, 0.05, (STEPS + 1, 3)), 0.0)
    data = recordings([], 1, steps=STEPS, seed=14)[0]
    data.runs[0].y[:] += off
    checked = check(declared(), data)
    alone = (np.abs(off) > 12.0 * NOISE).any(axis=1)  # two legs of at least six deviations of a residual, or nearly
    alone[1:] &= ~alone[:-1]
    alone[:-1] &= ~alone[1:]
    assert checked.faults == ()
    assert np.mean(np.isnan(checked.data.runs[0].y[1:-1][alone[1:-1]]).all(axis=1)) > 0.85
    assert np.mean(np.isnan(checked.data.runs[0].y[~(off != 0.0).any(axis=1)]).any(axis=1)) < 0.02


@pytest.mark.parametrize("kind", ["dropout", "clock_step"])
def test_a_silence_is_told_from_a_clock_that_jumped(kind):
    rng = np.random.default_rng(9)
    u = commands(rng, 1, STEPS, DT, [(0.1, 0.2), (-1.0, 1.0)], rest=0.0)
    y = drive(rng, "unicycle", u, ROBOTARIUM, DT, NOISE)[0]
    t = DT * np.arange(STEPS + 1)
    keep = np.ones(STEPS + 1, dtype=bool)
    if kind == "dropout":
        keep[400:420] = False
    else:
        t[400:] += 20 * DT
    data = from_streams(declared(), [(Stream(t[keep], y[keep]), Stream(t[:-1], u[0]))], "here")
    assert np.count_nonzero(np.isfinite(data.runs[0].y).all(axis=1)) == np.count_nonzero(keep)
    checked = check(declared(), data)
    (fault,) = checked.faults
    assert (fault.kind, fault.channel) == (kind, "*")
    across = [step for _, step in checked.left_out]  # no rollout goes on in time that there was not
    assert across == (list(range(399, 420)) if kind == "clock_step" else [])
    assert fault.from_s == pytest.approx(399 * DT, abs=1e-6)


def test_a_lost_row_is_no_clock_that_jumped_where_the_model_turns_too_fast():
    """One step of the model leads nearly as far then as the robot goes in two."""
    rng = np.random.default_rng(21)
    slow, fast = rng.uniform([-0.05, -0.2], [0.05, 0.2], (40, 2)), rng.uniform([-0.05, 1.8], [0.05, 2.2], (40, 2))
    u = np.repeat(np.where((np.arange(40) % 4 == 1)[:, None], fast, slow), 50, axis=0)
    y = drive(rng, "unicycle", u[None] * [1.0, 0.6], (), 0.05, [0.003, 0.003, 0.004])[0][:-1]
    t, kept = 0.05 * np.arange(len(u)), np.arange(len(u)) % 200 != 75
    model = compose(ModelSpec("unicycle", 0.05))
    found = check(model, from_streams(model, [(Stream(t[kept], y[kept]), Stream(t[kept], u[kept]))], "here")).faults
    assert [f for f in found if f.kind == "clock_step"] == []


def test_a_clock_that_jumped_while_the_robot_turned_is_told_by_where_the_model_leads():
    """It is told to turn the other way then, so that what it did before and after are two things; but it is where one step leads."""
    rng = np.random.default_rng(9)
    t = 0.1 * np.arange(400)
    u = np.where(t[:, None] < 20.5, [0.3, 1.0], [-0.1, -1.0])[None]
    model = compose(ModelSpec("unicycle", 0.1, {}, (EffectSpec("integration_scheme", "*", {"scheme": "exact"}),)))
    y = drive(rng, "unicycle", u, (), 0.1, NOISE)[0][:-1]
    late = t + np.where(np.arange(400) < 205, 0.0, 2.0)
    found = check(model, from_streams(model, [(Stream(late, y), Stream(late, u[0]))], "here")).faults
    assert [(f.kind, f.channel, round(f.from_s, 3)) for f in found] == [("clock_step", "*", 20.4)]
    gone = np.delete(np.arange(400), np.arange(205, 225))
    found = check(model, from_streams(model, [(Stream(t[gone], y[gone]), Stream(t[gone], u[0, gone]))], "here")).faults
    assert [(f.kind, f.channel) for f in found] == [("dropout", "*")]


def _driver(seed, effects=(), spoil=None):
    """A car at up to 14 m/s, by a driver who moves wheel and pedal smoothly; its GPS is good to 2 cm."""
    rng, dt, steps = np.random.default_rng(seed), 0.1, 800
    asked = commands(rng, 1, steps, dt, [(-0.15, 0.15), (4.0, 14.0)], rest=0.0)[0]
    u = np.empty_like(asked)
    u[0] = asked[0]
    for k in range(1, steps):
        u[k] = u[k - 1] + dt * (asked[k] - u[k - 1]) / [0.5, 1.5]
    arcs = EffectSpec("integration_scheme", "*", {"scheme": "exact"})
    model = compose(ModelSpec("bicycle", dt, {"wheel_base": 2.7}, (arcs,)))
    robot = compose(ModelSpec("bicycle", dt, {"wheel_base": 2.7}, (*effects, arcs)))
    x, hidden = np.array([[0.0, 0.0, 0.0, u[0, 1]]]), robot.at_rest(1)
    rows = []
    for k in range(steps + 1):
        rows.append(x[0])
        if k < steps:
            x, hidden = robot.step(x, u[k : k + 1], hidden)
    y = np.array(rows) + rng.normal(size=(steps + 1, 4)) * [0.02, 0.02, 0.003, 0.03]
    if spoil:
        spoil(y)
    t = dt * np.arange(steps + 1)
    return check(model, from_streams(model, [(Stream(t, y), Stream(t[:-1], u))], "here")).faults


@pytest.mark.parametrize("seed", range(3))
def test_a_position_that_jumps_by_less_than_a_car_goes_in_a_step_is_told(seed):
    """It goes 1.4 m a step; for 25 s its receiver had no fixed solution, and was 0.86 m off."""

    def drifted(y):
        y[400:600, :2] += [0.7, -0.5]

    found = [(f.kind, f.channel, round(f.from_s, 1), round(f.to_s, 1)) for f in _driver(seed, spoil=drifted)]
    assert found == [("offset_jump", "x", 40.0, 59.9), ("offset_jump", "y", 40.0, 59.9)]


@pytest.mark.parametrize(
    "effect",
    [
        EffectSpec("input_delay", "*", {"delay": 0.5}),
        EffectSpec("input_rate_limit", "speed_cmd", {"rate": 0.5}),
        EffectSpec("input_saturation", "speed_cmd", {"low": -9.0, "high": 9.0}),
        EffectSpec("input_backlash", "steer_cmd", {"width": 0.1}),
        EffectSpec("regime_change", "*", {"time": 30.0, "gain": 0.5}),
        EffectSpec("input_deadband", "speed_cmd", {"width": 4.0}),
    ],
    ids=lambda e: e.name,
)
def test_what_a_car_lacks_is_no_jump_of_its_position(effect):
    assert _driver(5, (effect,)) == ()


@pytest.mark.parametrize("apart", [0.0, 0.05])
def test_a_joint_that_jumps_by_two_of_its_rows_is_told(apart):
    """At 6 rad/s it goes 24 mrad in a row; its force changes that by a hundredth."""
    model, rng = compose(ModelSpec("joint", 0.004)), np.random.default_rng(1)
    t = 0.004 * np.arange(1500)
    force = 20.0 * np.cos(3.3 * t) + 4.0 * np.cos(7.0 * t + 1.0)
    x, rows = np.zeros((1, 2)), []
    for u in force[:, None]:
        rows.append(x[0])
        x = model.nominal.step(x, u[None], 0.004, model.parameters)
    y = np.array(rows) + rng.normal(size=(1500, 2)) * [1e-4, 5e-3]
    y[700:, 0] += apart
    found = check(model, from_streams(model, [(Stream(t, y), Stream(t, force[:, None]))], "a table")).faults
    assert [(f.kind, f.channel) for f in found] == ([("offset_jump", "q")] if apart else [])
    assert all(f.from_s == pytest.approx(t[700]) for f in found)


TANK = """import numpy as np

STATES, INPUTS, PARAMS = ("level",), ("pump",), {}


def step(x, u, dt, params):
    return np.maximum(x + dt * (0.25 * u - 0.18 * np.sqrt(np.maximum(x, 0.0))), 0.0)
"""


def _level(tmp_path, spoil, seed):
    """A tank that is pumped into by turns, its level to half a centimetre."""
    (tmp_path / "tank.py").write_text(TANK)
    model = compose(ModelSpec(str(tmp_path / "tank.py"), 4.0))
    rng = np.random.default_rng(seed)
    u = np.repeat(rng.uniform(0.6, 3.4, 60), rng.integers(4, 18, 60))[:, None]
    level = np.full((1, 1), 4.0)
    rows = [level[0]]
    for k in range(len(u)):
        level = model.nominal.step(level, u[k : k + 1], 4.0, {})
        rows.append(level[0])
    y = np.array(rows) + rng.normal(size=(len(rows), 1)) * 0.02
    spoil(y)
    y = np.round(y / 0.005) * 0.005
    t = 4.0 * np.arange(len(y))
    return check(model, from_streams(model, [(Stream(t, y), Stream(t[:-1], u))], "here")).faults


@pytest.mark.parametrize("seed", range(3))
def test_a_level_that_froze_while_the_tank_filled_is_told_though_it_would_have_settled(tmp_path, seed):
    def spoil(y):
        y[200:240] = y[200]

    (fault,) = _level(tmp_path, spoil, seed)
    assert fault.kind == "frozen"
    assert (fault.from_s / 4.0, fault.to_s / 4.0) == pytest.approx((200, 239), abs=1)


def _slow_car(seed, spoil=None, noise=0.02, digits=None, made=None):
    """(found frozen speeds, measured speed) of a car whose speed follows its commands with a lag of 0.4 s, which it knows nothing of."""
    rng = np.random.default_rng(seed)
    model = compose(ModelSpec("bicycle", 0.05, {"wheel_base": 0.33}))
    u = commands(rng, 1, 1200, 0.05, [(-0.3, 0.3), (0.2, 2.0)], rest=0.0)[0]
    speed, pose = [0.0], [np.zeros(3)]
    for steer, wanted in u:
        speed.append(wanted + (speed[-1] - wanted) * np.exp(-0.05 / 0.4))
        went = 0.05 * 0.5 * (speed[-1] + speed[-2])
        turned = went * np.tan(steer) / 0.33
        middle = pose[-1][2] + 0.5 * turned
        pose.append(pose[-1] + np.array([went * np.cos(middle), went * np.sin(middle), turned]))
    y = np.column_stack([np.array(pose) + rng.normal(size=(1201, 3)) * [0.001, 0.001, 0.002], np.array(speed)])
    if spoil:
        spoil(y[:, 3])
    if made:
        made(y[:, 3], u)
    y[:, 3] += noise * rng.normal(size=1201)
    return model, u, y if digits is None else np.round(y, digits)


def _frozen_of(model, u, y):
    t = 0.05 * np.arange(len(y))
    found = check(model, from_streams(model, [(Stream(t, y), Stream(t[:-1], u))], "here")).faults
    return [(f.channel, round(f.from_s / 0.05), round(f.to_s / 0.05)) for f in found if f.kind == "frozen"]


@pytest.mark.parametrize("seed", range(6))
def test_a_speed_that_repeats_exactly_and_jitters_otherwise_is_frozen(seed):
    """However slowly it follows its commands."""
    model, u, y = _slow_car(seed)
    assert _frozen_of(model, u, y) == []
    y[700:730, 3] = y[700, 3]
    assert _frozen_of(model, u, y) == [("speed", 700, 729)]


def test_a_speed_that_froze_twice_is_frozen_twice():
    model, u, y = _slow_car(1)
    y[300:330, 3], y[700:730, 3] = y[300, 3], y[700, 3]
    assert _frozen_of(model, u, y) == [("speed", 300, 329), ("speed", 700, 729)]


@pytest.mark.parametrize("digits", [None, 4])
@pytest.mark.parametrize("lag", [1e-6, 0.01, 0.4])
@pytest.mark.parametrize("gain", [0.8, 1.0])
def test_a_speed_that_follows_other_commands_every_row_need_not_jitter(gain, lag, digits):
    """Nor if it is slower than its commands, or follows late: what goes with them is no noise. They are held once."""

    def even(speed, u):
        u[:, 1] = np.random.default_rng(7).uniform(0.5, 2.0, len(u))
        u[700:731, 1] = u[700, 1]
        for k, wanted in enumerate(u[:, 1]):
            speed[k + 1] = gain * wanted + (speed[k] - gain * wanted) * np.exp(-0.05 / lag)

    assert _frozen_of(*_slow_car(2, noise=0.0, digits=digits, made=even)) == []


@pytest.mark.parametrize("digits", [None, 3, 6])
@pytest.mark.parametrize("seed", range(4))
def test_a_speed_that_is_read_without_noise_may_be_even_for_a_while(seed, digits):
    """It is never even elsewhere: only noise would not let it be so."""

    def even(speed):
        speed[700:730] = speed[700]

    assert _frozen_of(*_slow_car(seed, even, noise=0.0, digits=digits)) == []


@pytest.mark.parametrize("seed", range(4))
def test_a_speed_at_the_end_of_its_sensor_or_at_rest_is_not_frozen(seed):
    model, u, y = _slow_car(seed)
    at_end = y.copy()
    at_end[700:730, 3] = np.max(y[:, 3])
    at_end[400, 3] += 0.3  # one row that is off is no end
    at_rest = y.copy()
    at_rest[700:730, 3] = 0.0
    assert _frozen_of(model, u, at_end) == []
    assert _frozen_of(model, u, at_rest) == []


def _outlying(rng, shape):
    return np.where(rng.random((shape[0], 1)) < 0.03, rng.choice([-1.0, 1.0], shape) * rng.uniform(6.0, 12.0, shape), 0.0) * NOISE


def _heavy(rng, shape):
    return rng.standard_t(3, shape) * NOISE


@pytest.mark.parametrize("law", [_outlying, _heavy])
@pytest.mark.parametrize(("jump", "at"), [(0.08, 0), (-0.08, 1), (0.9, 2)])
@pytest.mark.parametrize("seed", range(3))
def test_a_jump_among_outliers_is_told(law, jump, at, seed):
    """Where wild rows are the sensor's noise, what stays is none of them."""

    def spoil(y):
        y += law(np.random.default_rng(seed), y.shape)
        y[400:, at] += jump

    found = [(f.kind, f.channel, round(f.from_s / DT), round(f.to_s / DT)) for f in _checked(spoil, seed=20 + seed).faults]
    assert found == [("offset_jump", ("x", "y", "theta")[at], 400, STEPS)]


def test_a_spike_does_not_hide_a_jump_among_outliers():
    def spoil(y):
        y += _outlying(np.random.default_rng(3), y.shape)
        y[400:, 0] += 0.08
        y[600, 0] += 0.06

    assert ("offset_jump", "x", 400) in [(f.kind, f.channel, round(f.from_s / DT)) for f in _checked(spoil, seed=23).faults]


@pytest.mark.parametrize("law", [_outlying, _heavy])
def test_outliers_by_themselves_are_no_jump(law):
    """Thirty recordings of either law."""
    for seed in range(30):

        def spoil(y, seed=seed):
            y += law(np.random.default_rng([seed, 1]), y.shape)

        assert [f for f in _checked(spoil, seed=100 + seed).faults if f.kind == "offset_jump"] == []


def _turning_joint(seed):
    """Led to and fro by a force that is known; its encoder is good to 0.1 mm. Rows of q and qd, and the force."""
    rng, dt, steps = np.random.default_rng(seed), 0.01, 1200
    u = 16.0 * np.sin(3.1 * dt * np.arange(steps)) + 6.0 * np.sin(7.3 * dt * np.arange(steps) + seed)
    x, rows = np.zeros(2), [np.zeros(2)]
    for now in u:
        x = x + dt * np.array([x[1] + 0.5 * dt * now, now])
        rows.append(x)
    return np.array(rows) + rng.normal(size=(steps + 1, 2)) * [1e-4, 5e-3], u


@pytest.mark.parametrize("seed", range(4))
def test_a_row_that_stands_where_the_one_before_did_is_late_if_all_of_it_does(seed):
    """An encoder that is off for one row by what the joint goes in a step: its speed tells that the row is in time."""
    model = compose(ModelSpec("joint", 0.01, {"mass": 1.0}))
    y, u = _turning_joint(seed)
    k = int(np.argmax(np.abs(y[1:-1, 1]) * (np.abs(u[1:]) > 10.0))) + 1  # where it goes, and changes how fast
    t = 0.01 * np.arange(len(y))

    def faults(rows):
        return [
            (f.kind, f.channel, round(f.from_s, 3))
            for f in check(model, from_streams(model, [(Stream(t, rows), Stream(t[:-1], u[:, None]))], "here")).faults
        ]

    off = y.copy()
    off[k, 0] = y[k - 1, 0]
    assert faults(off) == [("spike", "q", round(0.01 * k, 3))]
    late = y.copy()
    late[k] = y[k - 1] + np.random.default_rng(seed).normal(size=2) * [1e-4, 5e-3]
    assert faults(late) == []


def test_a_run_in_which_a_state_was_not_measured_says_nothing_of_its_rows():
    """Nor does one whose position is stale now and then, for ever: that is how its rows come."""
    model = compose(ModelSpec("joint", 0.01, {"mass": 1.0}))
    y, u = _turning_joint(0)
    off = y.copy()
    off[300, 0] = off[299, 0]
    off[:, 1] = np.nan
    assert check(model, from_arrays(model, [(y, u[:, None]), (off, u[:, None])])).faults == ()
    stale = y.copy()
    for k in np.flatnonzero(np.abs(np.diff(y[:, 0])) > 0.05)[::60]:
        stale[k + 1, 0] = y[k, 0]
    assert check(model, from_arrays(model, [(stale, u[:, None])])).faults == ()
