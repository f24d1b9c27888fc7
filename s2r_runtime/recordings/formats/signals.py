"""How a signal is named, and which numbers of which topic that is.

    TOPIC.FIELD          /odom.pose.pose.position.x, vehicle_local_position.x, ATT.Yaw; of a table the column alone
    FIELD                where one topic only has it
    TOPIC.ORIENTATION    the yaw of a quaternion (four fields .x .y .z .w; PX4's q[0] to q[3], w first), rad
    ...*FACTOR           times a number: another unit, or another sign

A unit that the file states is brought to SI. Parts that wrap a message may be left out or be one too many (`/cmd_vel.twist.linear.x` of a
plain Twist), as long as only one field fits.
"""

from __future__ import annotations

import difflib
import re
from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np

from s2r_runtime.errors import UsageError
from s2r_runtime.recordings.formats.series import Array, Topic
from s2r_runtime.recordings.units import factor_of

_FACTOR = re.compile(r"(.*?)\s*\*\s*([-+]?[0-9.]+(?:[eE][-+]?[0-9]+)?)")
XYZW = ("x", "y", "z", "w")
NEAREST = 3
"""Signals that a message names as near to one that is not there."""
UNIT_NORM = (0.5, 1.5)
"""Norm of a quaternion that is one; drivers that know no orientation send zeros."""


class Signal(NamedTuple):
    """fields: one, or the four (x, y, z, w) of a quaternion whose yaw is meant. factor: to SI, and as the user wrote. unit: the file's."""

    topic: str
    fields: tuple[str, ...]
    factor: float
    unit: str
    name: str

    def values(self, columns: Mapping[str, Array]) -> Array:
        """(N,), NaN where there is no value."""
        if len(self.fields) == 1:
            return np.asarray(self.factor * columns[self.fields[0]])
        x, y, z, w = (columns[one] for one in self.fields)
        norm = np.sqrt(x * x + y * y + z * z + w * w)
        with np.errstate(invalid="ignore"):
            yaw = np.arctan2(2.0 * (w * z + x * y), w * w + x * x - y * y - z * z)
            fits = (norm > UNIT_NORM[0]) & (norm < UNIT_NORM[1])
        return np.asarray(self.factor * np.where(fits, yaw, np.nan))


def quaternions(fields: Sequence[str] | Mapping[str, str]) -> dict[str, tuple[str, ...]]:
    """Orientation -> its fields (x, y, z, w)."""
    there = set(fields)
    found: dict[str, tuple[str, ...]] = {}
    for field in fields:
        if field.endswith(".w") and (four := tuple(f"{field[:-2]}.{axis}" for axis in XYZW)) and there.issuperset(four):
            found[field[:-2]] = four
        if field.endswith("[3]") and field[:-3].rpartition(".")[2] in ("q", "q_d", "delta_q_reset"):
            base = field[:-3]
            four = tuple(f"{base}[{index}]" for index in (1, 2, 3, 0))
            if there.issuperset(four):
                found[base] = four
    return found


def paths_of(topic: Topic) -> dict[str, tuple[str, ...]]:
    """What can be named of a topic: field or orientation -> fields."""
    return {field: (field,) for field in topic.fields} | quaternions(topic.fields)


def full_name(topic: str, path: str) -> str:
    """`TOPIC.FIELD`."""
    return f"{topic}.{path}" if topic else path


def resolve(text: str, topics: Sequence[Topic], where: str) -> Signal:
    """The signal that is meant. where: file and option, for the message. Raises UsageError naming the nearest signals."""
    wanted, factor = text.strip(), 1.0
    if match := _FACTOR.fullmatch(wanted):
        wanted, factor = match.group(1), float(match.group(2))
    if not 0.0 < abs(factor) < float("inf"):
        raise UsageError(f"{where}: the factor of {text!r} must be a finite number other than 0")
    there = [(topic, path, fields) for topic in topics for path, fields in paths_of(topic).items()]
    for fits in (_is, _is_field, _wraps):
        found = [one for one in there if fits(wanted, one[0].name, one[1])]
        if len(found) == 1:
            topic, path, fields = found[0]
            unit = "rad" if len(fields) > 1 else topic.fields[fields[0]]
            return Signal(topic.name, fields, factor * (factor_of(unit) or 1.0), unit, full_name(topic.name, path))
        if found:
            names = ", ".join(full_name(topic.name, path) for topic, path, _ in found[:NEAREST])
            raise UsageError(f"{where}: {wanted!r} may be {names}; write the topic before it")
    raise UsageError(f"{where}: there is no signal {wanted!r}{_near(wanted, topics)}")


def _is(wanted: str, topic: str, path: str) -> bool:
    return wanted.lstrip("/") == full_name(topic, path).lstrip("/")


def _is_field(wanted: str, topic: str, path: str) -> bool:
    return wanted == path


def _wraps(wanted: str, topic: str, path: str) -> bool:
    """Whether the rest after the topic is the end of the path, or the path its end."""
    bare, name = wanted.lstrip("/"), topic.lstrip("/")
    if not name or not bare.startswith(name + "."):
        return False
    rest = bare[len(name) + 1 :]
    return path.endswith("." + rest) or rest.endswith("." + path)


def _why_none(topics: Sequence[Topic]) -> str:
    """Why a file has no signal at all, as its reader says."""
    return next((f": {topic.name} has no numbers: {topic.note}" for topic in topics if topic.note), "")


def _near(wanted: str, topics: Sequence[Topic]) -> str:
    own = [topic for topic in topics if topic.name and wanted.lstrip("/").startswith(topic.name.lstrip("/") + ".")]
    names = [full_name(topic.name, path) for topic in (own or topics) for path in paths_of(topic)]
    if not own and (named := next((topic for topic in topics if topic.name.lstrip("/") == wanted.lstrip("/")), None)):
        names = [full_name(named.name, path) for path in paths_of(named)]
        return (
            f": that is a topic; its signals: {', '.join(names[:8])}" if names else f": that is a topic {named.note or 'without numbers'}"
        )
    near = difflib.get_close_matches(wanted, names, NEAREST, 0.5)
    listed = f"; nearest: {', '.join(near)}" if near else f"; there are: {', '.join(names[:8])}" if names else _why_none(topics)
    return f"{listed} (s2r topics lists all)"
