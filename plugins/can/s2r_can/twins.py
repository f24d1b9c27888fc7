"""A second node that sends one of the robot's messages: one identifier, two senders (`s2r_runtime.twins`).

With a rolling counter: the frames that were not taken count on by themselves (each FOLLOWS steps on from the last one at most), say
something else than those that were taken under the same number, and the others go on. Frames that say the same are an echo; one whose
number was lost a moment ago is late.

Without one, where the cycle is known: more than MORE times as many frames as the cycle has in WINDOW_NS, and those that a busy machine may
hand over late besides. It takes about WINDOW_NS to notice.
"""

from __future__ import annotations

from collections import deque
from typing import Literal

from s2r_runtime.twins import Pair

FOLLOWS = 3
LATE_MOST = 16
"""Numbers by which a frame may be behind and be late."""
KEPT = 64
MORE = 1.5
WINDOW_NS = 2_000_000_000

Kind = Literal["echo", "late", "other"]


class CounterTwins:
    """Of one message with a counter of this modulus."""

    def __init__(self, modulus: int) -> None:
        self._modulus = modulus
        self._taken: deque[tuple[int, int]] = deque(maxlen=min(KEPT, max(1, modulus // 2)))
        self._pair, self._other = Pair(signs=2), -1

    def taken(self, counter: int, payload: bytes, now_ns: int, *, anew: bool) -> bool:
        """A frame counted. anew: its sender began to count anew. True: two nodes send, to be said now."""
        if anew:
            self._pair.forget()
            self._taken.clear()
            self._other = -1
        self._taken.append((counter, hash(payload)))
        return self._pair.goes_on(now_ns)

    def refused(self, counter: int, payload: bytes) -> Kind:
        """A frame's counter did not follow."""
        same = next((content for number, content in reversed(self._taken) if number == counter), None)
        if same == hash(payload):
            return "echo"
        behind = (self._taken[-1][0] - counter) % self._modulus if self._taken else 0
        if same is None and 0 < behind <= min(LATE_MOST, self._modulus // 4):
            return "late"
        if self._other >= 0 and not 1 <= (counter - self._other) % self._modulus <= FOLLOWS:
            self._pair.forget()
        self._other = counter
        self._pair.other()
        return "other"


class CycleTwins:
    """Of one message that comes in a known cycle. silence_ns: after so long without it, all that was counted is forgotten."""

    def __init__(self, cycle_ns: int, silence_ns: int) -> None:
        self._window_ns = max(WINDOW_NS, 32 * cycle_ns)
        self._most = int(MORE * self._window_ns / cycle_ns + silence_ns / cycle_ns) + 2
        self._silence_ns = silence_ns
        self._times: deque[int] = deque(maxlen=self._most + 1)
        self._pair = Pair()

    def came(self, now_ns: int) -> float:
        """A frame. s between frames, if two nodes send it and that is to be said now; else 0."""
        if self._times and now_ns - self._times[-1] > self._silence_ns:
            self._times.clear()
        self._times.append(now_ns)
        span = now_ns - self._times[0]
        if len(self._times) <= self._most or span > self._window_ns:
            return 0.0
        self._pair.other()
        return span * 1e-9 / self._most if self._pair.goes_on(now_ns) else 0.0
