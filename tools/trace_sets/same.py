"""Which names are one and the same on a robot, so that any of them is right. A list a missing effect: [[name, channel or null], ...].

A null channel stands for any: the effect has one channel on this robot, whatever it is called. Written apart from the library's own table.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from trace_sets.plants import Plant

if TYPE_CHECKING:
    from trace_sets.making import Draft, Missing

Name = tuple[str, str | None]

ONE_CHANNEL = {
    "wheel_saturation",
    "integration_scheme",
    "understeer",
    "gravity_slope",
    "lateral_slip",
    "longitudinal_slip",
    "track_scale",
    "heading_offset",
    "sensor_lever_arm",
    "position_field",
    "mass_change",
}


def accepted(draft: Draft) -> list[list[list[str | None]]]:
    """For each missing effect, all of its names."""
    return [[list(name) for name in names(draft.scale.plant, m, draft)] for m in draft.missing]


def names(plant: Plant, m: Missing, draft: Draft) -> list[Name]:
    """All names of one effect on this robot."""
    own: Name = (m.name, None if m.name in ONE_CHANNEL else m.channel)
    found: list[Name] = [own]
    for group in groups(plant):
        if own in group:
            found += [n for n in group if n != own]
    if len(plant.inputs) == 1 and m.channel in {"*", plant.inputs[0]}:
        found += [(m.name, "*"), (m.name, plant.inputs[0])]
    if m.name == "constant_disturbance" and plant.name == "unicycle" and m.channel == "body" and m.p["y"] == 0.0:
        found.append(("input_bias", "v"))
    if m.name == "input_bias" and plant.name == "double_integrator":  # a push along that axis alone
        found += [("constant_disturbance", "world"), ("gravity_slope", None)]
    if m.name == "input_bias" and plant.name == "unicycle" and m.channel == "v":
        found.append(("constant_disturbance", "body"))
    if m.name == "heading_offset":
        found.append(("sensor_offset", "theta"))
    return list(dict.fromkeys(found))


def groups(plant: Plant) -> list[list[Name]]:
    """Classes of effects that no data can tell apart."""
    if plant.name == "unicycle":
        return [[("track_scale", None), ("input_gain", "w")], [("longitudinal_slip", None), ("input_gain", "v")]]
    if plant.name == "joint":
        return [
            [("constant_disturbance", "world"), ("input_bias", "force"), ("gravity_slope", None)],
            [("mass_change", None), ("input_gain", "force")],
        ]
    if plant.name == "double_integrator":
        return [[("constant_disturbance", "world"), ("gravity_slope", None)]]
    if plant.name == "bicycle":
        gain: list[Name] = [("input_gain", "steer_cmd"), ("steering_ratio", "steer_cmd")]
        return [gain, [("input_bias", "steer_cmd"), ("steering_offset", "steer_cmd")]]
    return []


def share_a_name(draft: Draft) -> bool:
    """Whether two of its effects cannot be told apart, or are kinds of one thing on one channel."""
    lists = [names(draft.scale.plant, m, draft) for m in draft.missing]
    for i, first in enumerate(lists):
        for second in lists[i + 1 :]:
            if set(first) & set(second):
                return True
    dry = [m for m in draft.missing if m.name in {"coulomb_friction", "stribeck_friction"}]
    gains = [
        m for m in draft.missing if m.name in {"input_gain", "input_gain_asymmetry", "mass_change", "longitudinal_slip", "track_scale"}
    ]
    pushes = [m for m in draft.missing if m.name in {"input_bias", "constant_disturbance"}]
    noses = [m for m in draft.missing if m.name in {"understeer", "track_scale"}]
    return any(len(group) > 1 for group in (dry, gains, pushes, noses))


def alternatives(draft: Draft) -> list[list[list[list[str | None]]]]:
    """Other sets of effects that are the same thing: each a list as `accepted` gives it."""
    plant = draft.scale.plant
    found = []
    for i, m in enumerate(draft.missing):
        for other in _as_two(plant, m):
            rest = [list(map(list, names(plant, n, draft))) for k, n in enumerate(draft.missing) if k != i]
            found.append([*rest, *([list(name) for name in group] for group in other)])
    return found


def _as_two(plant: Plant, m: Missing) -> list[list[list[Name]]]:
    """Ways in which one effect is two others."""
    if m.channel == "*" and m.name in {"input_delay", "input_gain_drift", "regime_change"} and len(plant.inputs) == 2:
        return [[[(m.name, channel)] for channel in plant.inputs]]
    if m.name == "constant_disturbance" and plant.name == "double_integrator":
        return [[[("input_bias", "ax")], [("input_bias", "ay")]]]
    if m.name == "coulomb_friction" and "force_positive" in m.p:
        axis = plant.velocity.index(plant.states.index(m.channel))
        push: list[Name] = [("input_bias", plant.inputs[axis]), ("constant_disturbance", "world")]
        return [[[("coulomb_friction", m.channel)], push]]
    return []
