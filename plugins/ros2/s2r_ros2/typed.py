"""Messages of any type as numbers, through `rosbags`: by the definition that the bag holds, else by the one that ROS has.

a number, a bool     a field, by its path: pose.pose.position.x
an array             elements: position[0], at most ELEMENTS of them; also of messages
header, strings, covariances, images, clouds: no fields
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator, Mapping
from functools import lru_cache
from typing import Any

import numpy as np

from s2r_ros2.records import Channel, Definition

ELEMENTS = 16
"""Of an array that are fields; a longer one is an image, a scan or a cloud."""
DEPTH = 8
LARGEST_BYTES = 65_536
"""Of a message that has fields."""
OTHER_NAMES = {"tf/msg/tfMessage": "tf2_msgs/msg/TFMessage"}
SKIPPED = ("header", "covariance")
_STEP = re.compile(r"([^.\[\]]+)|\[(\d+)\]")

Getter = Callable[[Any], float]


class Types:
    """Decoders of a bag's types. definitions: as the bag has them, possibly none."""

    def __init__(self, definitions: Mapping[str, Definition]) -> None:
        self._definitions = definitions
        self._stores: dict[tuple[str, str], Any] = {}

    def decode(self, channel: Channel, data: bytes) -> Any:
        """The message as an object. Raises ValueError where that is not possible."""
        store = self._store(channel)
        try:
            if channel.encoding == "ros1":
                return store.deserialize_ros1(data, channel.kind)
            return store.deserialize_cdr(data, channel.kind)
        except Exception as error:  # noqa: BLE001 - generated code raises what it likes at bytes that are no such message
            raise ValueError(f"{channel.kind}: {type(error).__name__}") from None

    def to_cdr(self, channel: Channel, data: bytes) -> bytes:
        """A payload of ROS 1 as CDR of the same type in ROS 2, whose header has no sequence number. Raises ValueError."""
        if channel.encoding != "ros1":
            return data
        kind = OTHER_NAMES.get(channel.kind, channel.kind)
        store = _store_of(kind, "cdr", None)
        if store is None:
            raise ValueError(f"{channel.kind}: ROS 2 has no such type")
        try:
            return bytes(store.ros1_to_cdr(data, kind))
        except Exception as error:  # noqa: BLE001 - as above
            raise ValueError(f"{channel.kind}: {type(error).__name__}") from None

    def _store(self, channel: Channel) -> Any:
        """Raises ValueError for a type that nobody describes."""
        key = (channel.kind, channel.encoding)
        if key not in self._stores:
            self._stores[key] = _store_of(channel.kind, channel.encoding, self._definitions.get(channel.kind))
        if self._stores[key] is None:
            raise ValueError(f"{channel.kind}: neither the bag nor ROS says what it is")
        return self._stores[key]


@lru_cache(maxsize=256)
def _store_of(kind: str, encoding: str, definition: Definition | None) -> Any:
    """A type store that has the type; None if nobody describes it."""
    from rosbags.typesys import Stores, get_types_from_idl, get_types_from_msg, get_typestore

    usual = Stores.ROS1_NOETIC if encoding == "ros1" else Stores.LATEST
    if definition is not None:
        try:
            store: Any = get_typestore(Stores.EMPTY)
            if definition.language == "ros2idl":
                for text in re.split(r"^=+\n(?:IDL: .*\n)?", definition.text, flags=re.MULTILINE):
                    if text.strip():
                        store.register(get_types_from_idl(text))
            else:
                store.register(get_types_from_msg(definition.text, kind))
            store.get_msgdef(kind)
            return store
        except Exception:  # noqa: BLE001 - a definition that nobody can read is as good as none
            pass
    store = get_typestore(usual)
    return store if kind in store.fielddefs else None


def fields_of(message: Any) -> Iterator[str]:
    """Paths of the numbers of a message."""
    yield from _fields(message, "", 0)


def _fields(value: Any, path: str, depth: int) -> Iterator[str]:
    if isinstance(value, bool | int | float | np.number | np.bool_):
        yield path
    elif isinstance(value, np.ndarray):
        if value.ndim == 1 and value.dtype.kind in "biuf" and len(value) <= ELEMENTS:
            yield from (f"{path}[{k}]" for k in range(len(value)))
    elif isinstance(value, list | tuple):
        if len(value) <= ELEMENTS:
            for k, item in enumerate(value):
                yield from _fields(item, f"{path}[{k}]", depth + 1)
    elif depth < DEPTH and not isinstance(value, str | bytes):
        for name in getattr(value, "__dataclass_fields__", {}):
            if name not in SKIPPED and not name.startswith("__"):
                yield from _fields(getattr(value, name), f"{path}.{name}" if path else name, depth + 1)


def getter_of(path: str) -> Getter:
    """The number at a path; NaN where the message has none there."""
    steps: list[str | int] = [name or int(index) for name, index in _STEP.findall(path)]

    def get(message: Any) -> float:
        try:
            for step in steps:
                message = message[step] if isinstance(step, int) else getattr(message, step)
            return float(message)
        except (AttributeError, IndexError, TypeError, ValueError):
            return float("nan")

    return get


def stamp_of(message: Any) -> int:
    """ns of the header's stamp; 0 where it has none."""
    stamp = getattr(getattr(message, "header", None), "stamp", None)
    return 0 if stamp is None else int(stamp.sec) * 1_000_000_000 + int(stamp.nanosec)
