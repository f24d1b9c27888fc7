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
    if m.name == "heading_offset":
        found.append(("sensor_offset", "theta"))
    return list(dict.fromkeys(found))


def groups(plant: Plant) -> list[list[Name]]:
    """Classes of effects that no data can tell apart."""
    if plant.name == "unicycle":
        return [[("track_scale", None), ("input_gain", "w")], [("longitudinal_slip", None), ("input_gain", "v")]]
    if plant.name == "joint":
        return [
            [("constant_disturbance", "world"), ("input_bias", "force"), ("constant_disturbance", "body"), ("constant_disturbance", "*")],
            [("mass_change", None), ("input_gain", "force")],
        ]
    return []
