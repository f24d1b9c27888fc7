"""The wheels of a differential drive: radii, slip and their track, against the kinematics of two wheels written without the library."""

import numpy as np
import pytest

from s2r_runtime.effects.classes import same, several
from s2r_runtime.errors import ConfigError
from s2r_runtime.models.composed import compose
from s2r_runtime.modelspec import EffectSpec, ModelSpec
from s2r_runtime.plugins import registry

DT, ROWS, RADIUS, TRACK = 0.05, 80, 0.08, 0.4
ARC = ("integration_scheme", "*", {"scheme": "exact"})


def composed(name, *effects):
    parameters = {"wheel_radius": RADIUS, "track": TRACK} if name == "differential_drive" else {}
    return compose(ModelSpec(name, DT, parameters, tuple(EffectSpec(*e) for e in effects)))


def rolled(x, left, right, dt=DT, track=TRACK):
    """(n, 3) pose after the wheels rolled over the floor at these speeds, m/s, by one rotation about the instantaneous centre.

    A wheel at +-track/2 across the body moves along the heading; the two speeds fix the centre of rotation.
    """
    turn = (right - left) * dt / track
    straight = np.abs(right - left) < 1e-12
    centre = np.where(straight, 0.0, 0.5 * track * (right + left) / np.where(straight, 1.0, right - left))
    ahead = np.where(straight, left * dt, centre * np.sin(turn))
    aside = np.where(straight, 0.0, centre * (1.0 - np.cos(turn)))
    c, s = np.cos(x[:, 2]), np.sin(x[:, 2])
    return np.column_stack([x[:, 0] + c * ahead - s * aside, x[:, 1] + s * ahead + c * aside, x[:, 2] + turn])


def anywhere(name, seed=0):
    rng = np.random.default_rng(seed)
    wheels = rng.uniform(-9.0, 9.0, (ROWS, 2))
    left, right = RADIUS * wheels.T
    u = wheels if name == "differential_drive" else np.column_stack([(left + right) / 2.0, (right - left) / TRACK])
    return rng.uniform(-1.5, 1.5, (ROWS, 5 if name == "differential_drive" else 3)), u, left, right


def values(name, **p):
    return p if name == "differential_drive" else {**p, "track": TRACK}


@pytest.mark.parametrize("name", ["differential_drive", "unicycle"])
@pytest.mark.parametrize(("l", "r"), [(1.04, 1.0), (0.96, 1.04), (0.9, 0.9), (1.0, 0.0)])
def test_wheels_of_other_radii_roll_as_two_wheels_do(name, l, r):  # noqa: E741
    x, u, left, right = anywhere(name)
    x1 = composed(name, ARC, ("wheel_radius_scale", "*", values(name, left=l, right=r))).advance(x, u, u)
    assert np.allclose(x1[:, :3], rolled(x, l * left, r * right), rtol=0.0, atol=1e-12)
    if name == "differential_drive":
        assert np.array_equal(x1[:, 3:], u)  # encoders count turns, not metres


@pytest.mark.parametrize("name", ["differential_drive", "unicycle"])
def test_one_side_that_slips_moves_as_a_smaller_wheel_does(name):
    x, u, left, right = anywhere(name)
    slips = composed(name, ARC, ("wheel_slip", "*", values(name, left=0.0, right=0.3)))
    assert np.allclose(slips.advance(x, u, u)[:, :3], rolled(x, left, 0.7 * right), rtol=0.0, atol=1e-12)
    (other,) = same(slips.for_effects, "wheel_slip", "*", values(name, left=0.0, right=0.25))
    assert other == ("wheel_radius_scale", "*", values(name, left=1.0, right=0.75))


def test_a_wrong_track_is_the_track_that_the_wheels_really_have():
    x, u, left, right = anywhere("differential_drive")
    narrower = composed("differential_drive", ARC, ("track_scale", "theta", {"gain": TRACK / 0.35}))
    assert np.allclose(narrower.advance(x, u, u)[:, :3], rolled(x, left, right, track=0.35), rtol=0.0, atol=1e-12)


@pytest.mark.parametrize("name", ["differential_drive", "unicycle"])
def test_wheels_come_before_the_body_in_any_order_of_the_list(name):
    x, u, left, right = anywhere(name)
    radii, track = ("wheel_radius_scale", "*", values(name, left=1.05, right=0.9)), ("track_scale", "theta", {"gain": TRACK / 0.35})
    expected = rolled(x, 1.05 * left, 0.9 * right, track=0.35)
    for effects in ((radii, track), (track, radii)):
        assert np.allclose(composed(name, ARC, *effects).advance(x, u, u)[:, :3], expected, rtol=0.0, atol=1e-12)


@pytest.mark.parametrize("name", ["differential_drive", "unicycle"])
def test_radii_with_a_wrong_track_are_other_radii_with_a_slip_ahead(name):
    """So no recording distinguishes them."""
    x, u, *_ = anywhere(name)
    g = TRACK / 0.35
    track = composed(name, ARC, ("wheel_radius_scale", "*", values(name, left=1.05, right=0.9)), ("track_scale", "theta", {"gain": g}))
    slip = ("longitudinal_slip", "*", {"ratio": 1.0 - 1.0 / g})
    other = composed(name, ARC, ("wheel_radius_scale", "*", values(name, left=1.05 * g, right=0.9 * g)), slip)
    assert np.allclose(track.advance(x, u, u), other.advance(x, u, u), rtol=0.0, atol=1e-12)


@pytest.mark.parametrize("name", ["differential_drive", "unicycle"])
def test_wheels_of_one_wrong_radius_are_a_gain_of_speed_and_of_turning(name):
    bare = composed(name, ARC)
    ways = several(bare.for_effects, "wheel_radius_scale", "*", values(name, left=0.9, right=0.9))
    names = [{one[0] for one in way} for way in ways]
    assert {"longitudinal_slip", "track_scale"} in names
    assert ({"input_gain"} in names) == (name == "unicycle")
    assert several(bare.for_effects, "wheel_radius_scale", "*", values(name, left=0.9, right=0.91)) == []


def test_on_a_unicycle_unequal_wheels_couple_speed_and_turning():
    """v' = a v + (b track/2) w, w' = a w + (2 b/track) v: with l + r = 2 and driven straight, an input_coupling of w from v."""
    x = np.zeros((5, 3))
    u = np.column_stack([np.linspace(-1.0, 1.0, 5), np.zeros(5)])
    radii = composed("unicycle", ARC, ("wheel_radius_scale", "*", {"left": 0.98, "right": 1.02, "track": TRACK}))
    coupled = composed("unicycle", ARC, ("input_coupling", "w", {"from": "v", "coefficient": 2.0 * 0.02 / TRACK}))
    first, second = (model.step(x, u, model.at_rest(5))[0] for model in (radii, coupled))
    assert np.allclose(first, second, rtol=0.0, atol=1e-12)


@pytest.mark.parametrize(("loss", "arm"), [(0.02, 0.3), (0.01, 0.05), (5.0, 0.3)])
def test_a_castor_loads_the_wheels_by_its_drag_against_its_own_motion(loss, arm):
    """The forces on the wheels by their balance; each wheel gives way in proportion to its own, and neither speed changes its sign."""
    x, u, left, right = anywhere("differential_drive")
    v, w = (left + right) / 2.0, (right - left) / TRACK
    castor = np.column_stack([v, -arm * w])
    drag = -castor / np.linalg.norm(castor, axis=1, keepdims=True)  # of 1 N
    moment = -arm * drag[:, 1]  # of a force at (-arm, 0)
    forces = np.linalg.solve([[1.0, 1.0], [-TRACK / 2.0, TRACK / 2.0]], -np.stack([drag[:, 0], moment]))  # on the wheels, left and right
    given = 2.0 * loss * forces  # m/s: straight ahead each wheel has half of the drag
    ahead, turning = v - given.mean(axis=0), w - (given[1] - given[0]) / TRACK
    ahead, turning = np.where(ahead * v > 0.0, ahead, 0.0), np.where(turning * w > 0.0, turning, 0.0)
    half = 0.5 * TRACK * turning
    x1 = composed("differential_drive", ARC, ("castor_drag", "*", {"loss": loss, "arm": arm})).advance(x, u, u)
    assert np.allclose(x1[:, :3], rolled(x, ahead - half, ahead + half), rtol=0.0, atol=1e-12)
    assert np.array_equal(x1[:, 3:], u)
    still = composed("differential_drive", ("castor_drag", "*", {"loss": loss, "arm": arm}))
    assert np.array_equal(still.advance(x, 0.0 * u, 0.0 * u)[:, :3], x[:, :3])


def test_straight_ahead_at_one_speed_a_castor_is_a_slip():
    u = np.full((3, 2), 5.0)
    x = np.zeros((3, 5))
    castor = composed("differential_drive", ARC, ("castor_drag", "*", {"loss": 0.02, "arm": 0.3}))
    slip = composed("differential_drive", ARC, ("longitudinal_slip", "*", {"ratio": 0.02 / (5.0 * RADIUS)}))
    assert np.allclose(castor.advance(x, u, u), slip.advance(x, u, u), rtol=0.0, atol=1e-12)


@pytest.mark.parametrize("name", ["wheel_radius_scale", "wheel_slip"])
def test_only_what_has_two_wheels_has_them(name):
    effect = registry().get("effects", name)
    takes = {model: effect.channels(composed(model).nominal) for model in ("differential_drive", "unicycle", "bicycle", "joint")}
    assert takes == {"differential_drive": ("*",), "unicycle": ("*",), "bicycle": (), "joint": ()}
    with pytest.raises(ConfigError, match="track"):  # the model has one
        composed("differential_drive", (name, "*", {"left": 0.9, "right": 0.9, "track": 0.4}))
    with pytest.raises(ConfigError, match="lacks the parameter track"):
        composed("unicycle", (name, "*", {"left": 0.9, "right": 0.9}))


def test_a_model_file_with_a_track_of_its_own_needs_no_other(tmp_path):
    path = tmp_path / "mine.py"
    path.write_text(
        "import numpy as np\nSTATES, INPUTS, ANGLES = ('x', 'y', 'theta'), ('v', 'w'), ('theta',)\nPARAMS = {'track': 0.4}\n"
        "def step(x, u, dt, params):\n"
        "    return x + dt * np.column_stack([u[:, 0] * np.cos(x[:, 2]), u[:, 0] * np.sin(x[:, 2]), u[:, 1]])\n",
        encoding="utf-8",
    )
    model = compose(ModelSpec(str(path), DT, {}, (EffectSpec("wheel_radius_scale", "*", {"left": 1.0, "right": 0.9}),)))
    x1 = model.advance(np.zeros((1, 3)), np.array([[1.0, 0.0]]), np.array([[1.0, 0.0]]))
    assert x1[0, 2] == pytest.approx(-0.1 * DT / 0.4)
