"""The families `unopened`: valid, seeded, as large as they say, and their motion is that of an independent integration.

Never to be opened by whoever changes the tracer (tools/trace_sets/unopened.py).
"""

from __future__ import annotations

import copy
import json
import math
import sys
from collections.abc import Callable
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.integrate import solve_ivp

from s2r_runtime.models.composed import compose
from s2r_runtime.modelspec import EffectSpec, ModelSpec

TOOLS = Path(__file__).resolve().parents[1] / "tools"
sys.path.insert(0, str(TOOLS))

from trace_sets import unopened, vessel_model  # noqa: E402
from trace_sets.families import make  # noqa: E402
from trace_sets.making import Draft, drive  # noqa: E402
from trace_sets.noise import Noise  # noqa: E402
from trace_sets.recording import TraceSet  # noqa: E402
from trace_sets.targets import rows  # noqa: E402
from trace_sets.unopened_masses import MASSES  # noqa: E402
from trace_sets.unopened_poses import POSES  # noqa: E402
from trace_sets.vessel import VESSEL, hull_length  # noqa: E402
from trace_sets.world import Moment, World, rollout_errors  # noqa: E402

Array = NDArray[np.float64]
Rate = Callable[[float, Array, Array], Array]

OUTSIDE = [*unopened.KINDS, *unopened.ROBOT_KINDS]
DRAWN = {name: (unopened.draw_kind, kind) for name, kind in zip(unopened.KINDS, (*POSES, *MASSES), strict=True)}
DRAWN |= {name: (unopened.draw_vessel_kind, kind) for name, kind in zip(unopened.ROBOT_KINDS, VESSEL, strict=True)}


SEED = 1


@cache
def _made(name: str) -> tuple[TraceSet, np.random.Generator]:
    """A set, and the generator as it was when its recording was driven."""
    kept: list[np.random.Generator] = []
    real = unopened.realise

    def watched(rng: np.random.Generator, draft: Draft) -> Any:
        kept.append(copy.deepcopy(rng))
        return real(rng, draft)

    unopened.realise = watched
    try:
        return make(name, SEED), kept[-1]
    finally:
        unopened.realise = real


@pytest.mark.parametrize("name", unopened.UNOPENED)
def test_a_set_is_a_recording_with_its_truth_and_the_same_for_a_seed(name: str, tmp_path: Path) -> None:
    made, _ = _made(name)
    data, beside = made.write(tmp_path)
    (tmp_path / "again").mkdir()
    again, _ = make(name, SEED).write(tmp_path / "again")
    assert again.read_text() == data.read_text()
    truth = json.loads(beside.read_text())
    model = truth["model"]
    nominal = compose(ModelSpec(model["name"], model["dt"], model["parameters"], tuple(EffectSpec(**e) for e in model["effects"])))
    assert {"t", *nominal.states, *nominal.inputs} <= {*data.read_text().partition("\n")[0].split(",")}
    y = made.recording.runs[0].y
    assert len(y) >= 100
    assert np.isfinite(y[~np.isnan(y)]).all()
    if truth["expect"] == "clean":
        assert truth["ratio"] == pytest.approx(1.0)
        return
    assert truth["ratio"] >= unopened.STRONG
    assert truth["share"] == max(truth["shares"].values())
    assert 0.0 < truth["share"] <= 1.0
    if truth["expect"] == "outside":
        assert truth["words"]
        assert truth["depends_on"]
        assert truth["parameters"]
        assert not truth["effects"]
    else:
        assert truth["effects"][0]["name"] in {"input_delay", "input_lag", "input_gain_asymmetry", "constant_disturbance"}


@pytest.mark.parametrize("name", OUTSIDE)
def test_the_nominal_model_differs_by_the_stated_share(name: str) -> None:
    """Without noise the oracle makes no error, and the nominal model the effect's, whose square adds to that of the noise."""
    made, rng = _made(name)
    draft: Draft = made.draft
    states = draft.scale.plant.states
    assert made.truth["shares"] == unopened.one_step_shares(copy.deepcopy(rng), draft)
    _, starts = drive(copy.deepcopy(rng), draft, ahead=1, rollouts=unopened.ONE_STEP_ROLLOUTS)
    noisy = rollout_errors(starts, draft.nominal())
    quiet = replace(draft, noise=Noise("none", np.zeros(len(states))))
    _, starts = drive(rng, quiet, ahead=1, rollouts=unopened.ONE_STEP_ROLLOUTS)
    effect = rollout_errors(starts, quiet.nominal())
    assert np.all(effect.oracle < 0.02 * np.max(effect.nominal) + 1e-9)
    stated = np.array([*made.truth["shares"].values()])
    by_quiet = effect.nominal**2 / np.maximum(effect.nominal**2 + noisy.oracle**2, 1e-18)
    assert stated == pytest.approx(by_quiet, abs=0.2)  # the commands of a closed loop, and what is drawn after the noise, differ
    by_errors = 1.0 - (noisy.oracle / np.maximum(noisy.nominal, 1e-12)) ** 2
    assert stated == pytest.approx(np.where(noisy.nominal > 0.0, by_errors, 0.0), abs=0.2)  # the two add but by chance


def _pose(x: Array, v: float, w: float) -> list[float]:
    return [v * math.cos(x[2]), v * math.sin(x[2]), w]


def _body(d: Draft, u: Array) -> tuple[float, float]:
    """Speed and yaw rate of what acts."""
    p = d.scale.plant.parameters
    if d.scale.plant.name == "unicycle":
        return u[0], u[1]
    if d.scale.plant.name == "differential_drive":
        return 0.5 * p["wheel_radius"] * (u[0] + u[1]), p["wheel_radius"] * (u[1] - u[0]) / p["track"]
    return u[1], u[1] * math.tan(u[0]) / p["wheel_base"]


def _plain(d: Draft) -> Rate:
    return lambda t, z, u: np.array(_pose(z, *_body(d, u)))


def _battery(d: Draft, p: dict[str, float]) -> Rate:
    def rate(t: float, z: Array, u: Array) -> Array:
        load = np.mean([abs(c) / r.size for c, r in zip(u, d.scale.ranges, strict=True)])
        volts = 1.0 - p["r0"] * load - z[3]
        return np.array([*_pose(z, *_body(d, volts * u)), (p["r1"] * load - z[3]) / p["time_constant_s"]])

    return rate


def _castor(d: Draft, p: dict[str, float]) -> Rate:
    """By the velocity of the wheel's contact point, which may not move sideways."""

    def rate(t: float, z: Array, u: Array) -> Array:
        v, w = _body(d, u)
        along = np.array([math.cos(z[3]), math.sin(z[3])])
        across = np.array([-along[1], along[0]])
        pivot = np.array([v, w * p["ahead_m"]])
        swing = pivot @ across / p["trail_m"] - w
        roll = math.tanh(pivot @ along / (0.03 * d.scale.speed))
        return np.array([*_pose(z, v - p["speed_loss"] * roll * along[0], w - p["yaw_loss"] * roll * along[1]), swing])

    return rate


def _wheel(d: Draft, p: dict[str, float]) -> Rate:
    def rate(t: float, z: Array, u: Array) -> Array:
        eccentric = np.array(u)
        eccentric[int(p["wheel"])] *= 1.0 + p["share"] * math.cos(z[3])
        return np.array([*_pose(z, *_body(d, eccentric)), u[int(p["wheel"])]])

    return rate


def _governed(d: Draft, p: dict[str, float]) -> Rate:
    def rate(t: float, z: Array, u: Array) -> Array:
        v, w = _body(d, u)
        return np.array(_pose(z, float(np.clip(v, -p["acceleration"] / abs(w), p["acceleration"] / abs(w))), w))

    return rate


def _mast(d: Draft, p: dict[str, float]) -> Rate:
    """z[3]: the marker's own way ahead, z[4]: the base's, z[5]: the marker's speed."""
    omega = math.tau * p["frequency_hz"]

    def rate(t: float, z: Array, u: Array) -> Array:
        v, w = _body(d, u)
        return np.array([*_pose(z, z[5], w), z[5], v, -(omega**2) * (z[3] - z[4]) - 2.0 * p["damping"] * omega * (z[5] - v)])

    return rate


def _relaxed(d: Draft, p: dict[str, float]) -> Rate:
    def rate(t: float, z: Array, u: Array) -> Array:
        return np.array([*_pose(z, *_body(d, np.array([z[3], u[1]]))), abs(u[1]) / p["relaxation_length_m"] * (u[0] - z[3])])

    return rate


def _gripping(d: Draft, p: dict[str, float]) -> Rate:
    def rate(t: float, z: Array, u: Array) -> Array:
        v, w = _body(d, u)
        return np.array(_pose(z, v, w * (1.0 + (abs(v * w) / (9.81 * p["friction"])) ** 4) ** -0.25))

    return rate


def _linkage(d: Draft, p: dict[str, float]) -> Rate:
    off = p["off_square_rad"]

    def rate(t: float, z: Array, u: Array) -> Array:
        pulled = math.sin(u[0] + off) - math.sin(off)
        return np.array(_pose(z, *_body(d, np.array([math.asin(pulled / math.cos(off)), u[1]]))))

    return rate


def _two_masses(d: Draft, p: dict[str, float]) -> Rate:
    """z: link, its speed, motor, its speed, each against the world."""
    mass, motor = d.scale.plant.parameters["mass"], p["motor_mass_kg"]
    link, omega = mass - motor, math.tau * p["frequency_hz"]
    reduced = 1.0 / (1.0 / motor + 1.0 / link)

    def rate(t: float, z: Array, u: Array) -> Array:
        spring = reduced * (omega**2 * (z[2] - z[0]) + 2.0 * p["damping"] * omega * (z[3] - z[1]))
        return np.array([z[1], spring / link, z[3], (u[0] - spring) / motor])

    return rate


def _tank(d: Draft, p: dict[str, float]) -> Rate:
    """z: the tank's places and speeds, then the liquid's, each against the world."""
    n, mass = d.scale.plant.axes, d.scale.plant.parameters.get("mass", 1.0)
    omega = math.tau * p["frequency_hz"]

    def rate(t: float, z: Array, u: Array) -> Array:
        q, v, liquid, flow = z.reshape(4, n)
        spring = p["share"] * mass * (omega**2 * (liquid - q) + 2.0 * p["damping"] * omega * (flow - v))
        return np.concatenate([v, (u + spring) / (mass * (1.0 - p["share"])), flow, -spring / (mass * p["share"])])

    return rate


def _forced(d: Draft, force: Callable[[float, Array, Array, Array], Array]) -> Rate:
    n, mass = d.scale.plant.axes, d.scale.plant.parameters.get("mass", 1.0)
    return lambda t, z, u: np.concatenate([z[n:], force(t, z[:n], z[n:], u) / mass])


def _emf(d: Draft, p: dict[str, float]) -> Rate:
    stall, free = p["stall_force"], p["free_speed"]
    return _forced(d, lambda t, q, v, u: np.clip(u, -stall * (1.0 + v / free), stall * (1.0 - v / free)))


def _gear(d: Draft, p: dict[str, float]) -> Rate:
    return _forced(d, lambda t, q, v, u: u * p["efficiency"] ** (np.tanh(v / p["smooth_below"]) * np.sign(u)))


def _grease(d: Draft, p: dict[str, float]) -> Rate:
    return _forced(d, lambda t, q, v, u: u - p["coefficient"] * 2.0 ** (-t / (p["time_constant_s"] * math.log(2.0))) * v)


def _cogs(d: Draft, p: dict[str, float]) -> Rate:
    def force(t: float, q: Array, v: Array, u: Array) -> Array:
        poles = math.tau * q / p["pitch_m"]
        return u - p["force"] * (np.sin(poles + p["phase_rad"]) + p["second"] * np.sin(2.0 * poles))

    return _forced(d, force)


def _jet(d: Draft, p: dict[str, float]) -> Rate:
    along = np.array([math.cos(p["angle_rad"]), math.sin(p["angle_rad"])])

    def force(t: float, q: Array, v: Array, u: Array) -> Array:
        across = along[0] * q[1] - along[1] * q[0] - p["off_m"]
        return u + p["acceleration"] * math.exp(-(across**2) / (2.0 * p["width_m"] ** 2)) * along

    return _forced(d, force)


def _afloat(d: Draft, more: Callable[[float, Array, Array], Array]) -> Rate:
    """By the nominal model's own rate, and forces [surge N, sway N, yaw N m] more."""
    p = d.scale.plant.parameters
    masses = np.array([p["surge_mass"], p["sway_mass"], p["yaw_inertia"]])

    def rate(t: float, z: Array, u: Array) -> Array:
        still = vessel_model.rate(z[None], u[None], p)[0]
        return np.concatenate([still[:3], still[3:] + more(t, z, u) / masses])

    return rate


def _propellers(d: Draft, p: dict[str, float]) -> Rate:
    arm = 0.5 * d.scale.plant.parameters["beam"]

    def more(t: float, z: Array, u: Array) -> Array:
        lost = p["k"] * np.sqrt(np.abs(u)) * np.array([z[3] - arm * z[5], z[3] + arm * z[5]])
        return -np.array([lost.sum(), 0.0, arm * (lost[1] - lost[0])])

    return _afloat(d, more)


def _wind(d: Draft, p: dict[str, float]) -> Rate:
    length = hull_length(d.scale)
    front, side = 0.08 * length**2, 0.15 * length**2

    def more(t: float, z: Array, u: Array) -> Array:
        air = p["wind_m_s"] * np.exp(1j * (p["to_rad"] - z[2]))
        flow = complex(z[3], z[4]) - air
        drag = -0.6 * abs(flow) * np.array([p["c_x"] * front * flow.real, p["c_y"] * side * flow.imag])
        return np.array([*drag, -1.2 * p["c_n"] * side * length * flow.real * flow.imag])

    return _afloat(d, more)


def _bank(d: Draft, p: dict[str, float]) -> Rate:
    own = d.scale.plant.parameters

    def more(t: float, z: Array, u: Array) -> Array:
        distance = p["away_m"] - z[0] * math.cos(p["angle_rad"]) - z[1] * math.sin(p["angle_rad"])
        near = math.exp(-max(distance, 0.3 * hull_length(d.scale)) / p["reach_m"]) * z[3] ** 2 * math.sin(p["angle_rad"] - z[2])
        return np.array([0.0, own["sway_mass"] * p["pull_per_m"] * near, -own["yaw_inertia"] * p["turn_per_m2"] * near])

    return _afloat(d, more)


def _swell(d: Draft, p: dict[str, float]) -> Rate:
    sea: Any = d.outside[0]
    own, quarter = d.scale.plant.parameters, 0.25 * hull_length(d.scale)

    def more(t: float, z: Array, u: Array) -> Array:
        course = p["angle_rad"] - z[2]

        def at(ahead: float) -> float:
            place = math.cos(p["angle_rad"]) * (z[0] + ahead * math.cos(z[2])) + math.sin(p["angle_rad"]) * (z[1] + ahead * math.sin(z[2]))
            return sum(a * w**2 * math.sin(w * t - w**2 / 9.81 * place + phi) for w, a, phi in sea.waves)

        push = p["share"] * 0.5 * (at(quarter) + at(-quarter))
        turn = sea.yaw * p["share"] * (at(quarter) - at(-quarter)) * math.sin(course) / hull_length(d.scale)
        return np.array(
            [own["surge_mass"] * push * math.cos(course), own["sway_mass"] * push * math.sin(course), own["yaw_inertia"] * turn]
        )

    return _afloat(d, more)


RATES: dict[str, tuple[Callable[..., Rate], tuple[float, ...]]] = dict(
    zip(
        OUTSIDE,
        [
            (_battery, (0.0,)),
            (_castor, (0.3,)),
            (_wheel, ()),  # begins at the drawn angle
            (lambda d, p: _plain(d), ()),
            (lambda d, p: _plain(d), ()),
            (_governed, ()),
            (_mast, (0.0, 0.0, 0.0)),
            (_relaxed, (0.0,)),
            (_gripping, ()),
            (_linkage, ()),
            (_two_masses, ()),  # begins where the link is, and so does the liquid
            (_tank, ()),
            (_emf, ()),
            (_gear, ()),
            (_grease, ()),
            (_cogs, ()),
            (_jet, ()),
            (_propellers, ()),
            (_wind, ()),
            (_bank, ()),
            (_swell, ()),
        ],
        strict=True,
    )
)
"""Of each kind: its differential equation, and hidden states at the start."""


def _seen(name: str, d: Draft, x: Array) -> Array:
    """What is measured of true states, (n, nx), for kinds that lie in a sensor."""
    p, y = d.extra["parameters"], x.copy()
    if "B_rad" in p:
        a = x[:, 2]
        y[:, 2] += p["B_rad"] * np.sin(a) + p["C_rad"] * np.cos(a) + p["D_rad"] * np.sin(2 * a) + p["E_rad"] * np.cos(2 * a)
    if "k_per_m2" in p:
        off = x[:, :2] - [p["x_m"], p["y_m"]]
        y[:, :2] += p["k_per_m2"] * np.sum(off**2, axis=1, keepdims=True) * off
    return y


STEPS = 80


def _held(rng: np.random.Generator, d: Draft) -> Array:
    """(STEPS, nu) commands, each held for some steps."""
    few = rng.uniform(-1.0, 1.0, (STEPS // 4, len(d.scale.ranges)))
    low, size = (np.array([getattr(r, name) for r in d.scale.ranges]) for name in ("low", "size"))
    return np.repeat(np.where(low >= 0.0, 0.5 * (few + 1.0), few) * size, 4, axis=0)


def _run(world: World, u: Array, x0: list[float]) -> Array:
    """(STEPS + 1, nx) as measured, without noise."""
    moment = Moment(world, [np.repeat(column, world.parts).tolist() for column in u.T], list(x0))
    y = [world.measured(list(x0), 0.0)]
    for k in range(STEPS):
        for _ in range(world.parts):
            moment.part()
        y.append(world.measured(list(moment.x), (k + 1) * world.dt))
    return np.array(y)


def _integrated(rate: Rate, u: Array, z0: Array, dt: float) -> Array:
    z = [z0]
    for k in range(STEPS):
        span = (k * dt, (k + 1) * dt)
        done = solve_ivp(lambda t, y, held=u[k]: rate(t, y, held), span, z[-1], method="DOP853", rtol=1e-9, atol=1e-11, max_step=dt / 2)
        assert done.success
        z.append(done.y[:, -1])
    return np.array(z)


@pytest.mark.parametrize("name", OUTSIDE)
@pytest.mark.parametrize("seed", [3, 4])
def test_its_motion_is_that_of_an_independent_integration(name: str, seed: int) -> None:
    """What the two differ by is little of what the effect does: parts of a step are short."""
    draw, kind = DRAWN[name]
    rng = np.random.default_rng(seed)
    d = draw(rng, kind)
    plant, u = d.scale.plant, _held(rng, d)
    place = [float(rng.uniform(-0.5, 0.5)) * d.scale.speed for _ in range(plant.axes or 2)]
    x0 = [*place, 0.4, *[0.0] * (len(plant.states) - 3)] if plant.pose else [*place, *[0.0] * plant.axes]
    world = d.world()
    simulated, nominal = _run(world, u, x0), _run(d.nominal(), u, x0)
    of, hidden = RATES[name]
    shown = 3 if plant.name != "vessel" and plant.pose else len(plant.states)
    z0 = np.array([*x0[:shown], *hidden])
    if "phase_rad" in d.extra["parameters"] and "wheel" in d.extra["parameters"]:
        z0 = np.append(z0, d.extra["parameters"]["phase_rad"])
    if of in (_two_masses, _tank):
        z0 = np.tile(z0, 2)
    true = _seen(name, d, _integrated(of(d, d.extra["parameters"]), u, z0, d.scale.dt)[:, :shown])
    mistake = np.abs(true - simulated[:, :shown])
    size = np.max(np.abs(true - nominal[:, :shown]), axis=0)
    assert np.max(size) > 0.0
    assert np.all(np.max(mistake, axis=0) < 0.05 * np.maximum(size, 0.02 * np.max(size)))


def test_the_model_file_is_the_vessel_without_effects() -> None:
    d = unopened.draw_vessel_kind(np.random.default_rng(5), VESSEL[0])
    model, u = d.model(), _held(np.random.default_rng(6), d)
    nominal = compose(ModelSpec(model["name"], model["dt"], model["parameters"], ()))
    y = _run(d.nominal(), u, [0.1, -0.2, 0.3, 0.0, 0.0, 0.0])
    stepped, _ = nominal.step(y[:-1], u, nominal.at_rest(STEPS))
    assert np.max(np.abs(nominal.difference(y[1:].copy(), stepped))) < 1e-6
    true = _integrated(_afloat(d, lambda t, z, u: np.zeros(3)), u, y[0], d.scale.dt)
    assert np.max(np.abs(true - y)) < 1e-5


def test_the_table_has_rows_of_its_own() -> None:
    shown = [row.what for row in rows([])]
    assert sum("unopened" in what for what in shown) == 7
