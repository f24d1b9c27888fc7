"""J1939: a message is known by its parameter group, whatever node sends it, or by that and a stated source address.

    identifier, 29 bits:  priority 3 | group and destination 18 | source address 8

The priority does not count. Of a message whose source may be any, one node is believed at a time. A second one that sends it while the
first is there is reported, since nothing shows which is the robot's.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from s2r_can.records import ERROR, EXTENDED, REMOTE, key_of, spelled
from s2r_runtime.errors import ConfigError

if TYPE_CHECKING:
    from cantools.database.can import Message

    from s2r_can.layout import Inbound
    from s2r_can.options import Options

ANY = -1
SOURCE, PRIORITY = 0xFF, 0x7 << 26
SOURCE_MAX = 253
"""254 is no address yet, 255 everybody."""


def keyed(message: Message, options: Options) -> int:
    """The key of a message, with its stated source address."""
    key = key_of(message.frame_id, extended=message.is_extended_frame)
    source = options.source_addresses.get(message.name)
    if source is None:
        return key
    if not key & EXTENDED:
        raise ConfigError(f"transport.source_addresses.{message.name}: its identifier has 11 bits, and so no source address")
    return key if source == ANY else key & ~SOURCE | source


class Addresses:
    """Which message a frame is of. inbound: the messages that are read, by key."""

    def __init__(self, inbound: dict[int, Inbound], sources: dict[str, int], silence_ns: int = 0) -> None:
        self._stated = {m.key & ~PRIORITY: m.key for m in inbound.values() if sources.get(m.name, ANY) != ANY}
        self._any = {m.key & ~PRIORITY & ~SOURCE: m.key for m in inbound.values() if sources.get(m.name) == ANY}
        self._silence_ns = silence_ns
        self._heard: dict[int, tuple[int, int]] = {}
        self.used = bool(self._stated or self._any)

    def message(self, key: int) -> int:
        """The key of the message that a frame with this key is of; the frame's own where it is of none."""
        if not self.used or not key & EXTENDED or key & (ERROR | REMOTE):
            return key
        plain = key & ~PRIORITY
        return self._stated.get(plain) or self._any.get(plain & ~SOURCE) or key

    def twin(self, key: int, now_ns: int) -> str:
        """What is wrong if another node sent the same message a moment ago, or empty. key: the frame's."""
        message = self._any.get(key & ~PRIORITY & ~SOURCE)
        if message is None or key & (ERROR | REMOTE):
            return ""
        source = key & SOURCE
        known, at_ns = self._heard.get(message, (source, now_ns))
        if known != source and now_ns - at_ns <= self._silence_ns:
            return f"{spelled(message)} is sent from the addresses {known} and {source}: state one in transport.source_addresses"
        self._heard[message] = source, now_ns
        return ""
