"""Is a frame to be believed, and what does it say: one message's frames judged, and read into the list of values.

A frame counts if its length, its checksum and its counter are right and every number in it that is used is finite, in the DBC's range and
not marked invalid; else nothing of it does.
"""

from __future__ import annotations

from typing import NamedTuple

from s2r_can.bits import Bits, selected
from s2r_can.layout import Group, Inbound, Layout
from s2r_can.sequence import ACCEPTED, Kind, Sequence
from s2r_can.twins import CounterTwins, CycleTwins

WHY = {"echo": "an echo", "late": "it came late", "other": "not the robot's, or replayed"}
COUNTS = ("malformed", "checksum", "repeated", "old", "jumped", "lost")


class Heard(NamedTuple):
    """What a frame came to. groups: those that are good now; bad: those of which it was known that they were in it, and are not.

    twin: why two nodes send this message, if they do; refused: why a frame was dropped that is no fault of the robot's.
    wrong: what is wrong with it, if anything; believed: whether the frame is, whatever is wrong with numbers in it; kind, lost: as the
    counter says. little, big: the payload as integers.
    """

    groups: tuple[Group, ...]
    bad: tuple[Group, ...] = ()
    wrong: str = ""
    kind: Kind = "next"
    lost: int = 0
    little: int = 0
    big: int = 0
    believed: bool = True
    twin: str = ""
    refused: str = ""


class Hearing:
    """`values`: SI, by index; `counts`: of what was not believed, and of frames lost before those that were."""

    def __init__(self, layout: Layout, silence_ns: int) -> None:
        self.values = [0.0] * layout.values
        self.counts = dict.fromkeys(COUNTS, 0)
        self._sequences = {
            m.key: Sequence(m.counter.modulus, cycle_ns=m.counter.cycle_ns, jump=m.counter.jump, silence_ns=silence_ns)
            for m in layout.inbound.values()
            if m.counter is not None
        }
        self._counters = {m.key: CounterTwins(m.counter.modulus) for m in layout.inbound.values() if m.counter is not None}
        self._cycles = {
            m.key: CycleTwins(m.cycle_ns, silence_ns) for m in layout.inbound.values() if m.counter is None and m.cycle_ns
        }  # fmt: skip
        self._all = {m.key: tuple(m.groups) for m in layout.inbound.values()}

    def frame(self, message: Inbound, payload: bytes, now_ns: int) -> Heard:
        """Judges and reads one. now_ns: when it came."""
        groups = self._all[message.key]
        if len(payload) != message.length:
            if len(payload) not in message.lengths:
                self.counts["malformed"] += 1
                return _refused(groups, f"{message.name} has {len(payload)} bytes, must have {message.length}")
            payload = payload[: message.length]
        little, big = int.from_bytes(payload, "little"), int.from_bytes(payload, "big")
        if message.checksum is not None:
            bits, guard = message.checksum
            if field(bits, little, big) != guard.expected(payload):
                self.counts["checksum"] += 1
                return _refused(groups, f"{message.name} has a wrong checksum")
        kind: Kind = "next"
        lost, twin = 0, ""
        if message.counter is not None:
            counter, twins = field(message.counter.bits, little, big), self._counters[message.key]
            kind, lost = self._sequences[message.key].judge(counter, now_ns)
            if kind not in ACCEPTED:
                self.counts[kind] += 1
                what = twins.refused(counter, payload)
                if kind == "jumped":
                    return _refused(groups, f"the counter of {message.name} jumped")
                return _refused((), "")._replace(refused=f"{message.name} {counter}: {WHY[what]}")
            self.counts["lost"] += lost
            if twins.taken(counter, payload, now_ns, anew=kind in ("resumed", "restarted")):
                twin = f"two nodes send {message.name}: its counter goes on in two tracks"
        elif message.key in self._cycles and (each := self._cycles[message.key].came(now_ns)):
            told = f"its cycle is {message.cycle_ns * 1e-6:g} ms (transport.cycles, or the DBC)"
            twin = f"two nodes send {message.name}: it comes every {each * 1e3:.3g} ms, {told}"
        good, bad, wrong = [], [], ""
        for group in groups:
            if group.selectors and not selected(group.selectors, payload):
                continue
            said = group.read(little, big, self.values) if group.read is not None else ""
            if said:
                self.counts["malformed"] += 1
                bad.append(group)
                wrong = said
            else:
                good.append(group)
        return Heard(tuple(good), tuple(bad), wrong, kind, lost, little, big, twin=twin)


def _refused(groups: tuple[Group, ...], why: str) -> Heard:
    return Heard((), groups, why, believed=False)


def field(bits: Bits, little: int, big: int) -> int:
    """An unsigned integer's raw value."""
    return ((big if bits.big else little) >> bits.shift) & bits.mask
