"""What runs on a bus with a number on it, judged frame by frame: rolling counters, and the robot's own clock.

A counter counts from 0 to modulus - 1 and begins anew. From the last frame that was accepted to this one, with
delta = (counter - last) mod modulus:

    delta = 0                      the same frame again: replayed, or duplicated                          repeated
    1 <= delta <= jump             delta - 1 frames were lost                                             next
    -jump <= delta - modulus < 0   behind a newer one                                                     old
    else                           nothing that a loss explains: the frame is not believed                jumped

    jump = modulus / 4; where the cycle is known no more than the time since then allows, times SLACK, and FRAMES more

Whoever is not believed three times in a row, each time one step on from the time before and about a cycle later, is: the sender began to
count anew (`restarted`). Where the DBC does not say the cycle, it is what the sender kept so far. A frame that is accepted in between
ends such a row, so that what is replayed beside a living sender stays out. After `silence` without any, the next one may count from
anywhere too (`resumed`); how many were lost is then known by the cycle only. A counter is no proof of who sent it: docs/can.md.

A clock of n bits goes on by (ticks - last) mod 2^n if that is less than half of its range; else it ran back, which is believed of
a robot that started anew, by the same rule of three.
"""

from __future__ import annotations

from typing import Literal

Kind = Literal["first", "next", "resumed", "restarted", "repeated", "old", "jumped"]
ACCEPTED = frozenset({"first", "next", "resumed", "restarted"})

SLACK = 1.5
"""Cycles are kept within some percent; what came late came together."""
FRAMES = 2
ROW = 3
LEARNT = 8
"""Intervals over which the usual one is averaged."""
RESTART_GAP_NS = 1_000_000_000
"""So far a robot's clock is set on when it started anew: a hole that nobody takes for one period."""


class Sequence:
    """One message's counter. modulus >= 2; cycle_ns: 0 if it isn't known; jump: the largest step that counts as a loss (0: by rule)."""

    def __init__(self, modulus: int, *, cycle_ns: int = 0, silence_ns: int, jump: int = 0) -> None:
        self._modulus, self._cycle_ns, self._silence_ns = modulus, cycle_ns, silence_ns
        self._jump = jump or max(1, modulus // 4)
        self._last = self._odd = -1
        self._row = 0
        self._last_ns = self._odd_ns = self._usual_ns = 0

    def judge(self, counter: int, now_ns: int) -> tuple[Kind, int]:
        """(what the frame is, how many were lost before it). now_ns: when it came."""
        modulus, last = self._modulus, self._last
        if counter >= modulus:
            return "jumped", 0
        if last < 0:
            return self._accept("first", counter, now_ns), 0
        delta, passed_ns = (counter - last) % modulus, now_ns - self._last_ns
        if passed_ns > self._silence_ns:
            lost = self._lost_in_silence(delta, passed_ns)
            return self._accept("next" if 1 <= delta <= self._jump else "resumed", counter, now_ns), lost
        jump = self._jump
        if self._cycle_ns:
            jump = min(jump, int(SLACK * passed_ns / self._cycle_ns) + FRAMES)
        if 1 <= delta <= jump:
            if delta == 1:
                self._usual_ns += (passed_ns - self._usual_ns) // (LEARNT if self._usual_ns else 1)
            return self._accept("next", counter, now_ns), delta - 1
        if self._goes_on(counter, now_ns):
            return self._accept("restarted", counter, now_ns), 0
        if delta == 0:
            return "repeated", 0
        return ("old" if modulus - delta <= self._jump else "jumped"), 0

    def _lost_in_silence(self, delta: int, passed_ns: int) -> int:
        """The most that counter and cycle allow; none where the counter goes on by one: then the sender paused, in all likelihood."""
        least = (delta - 1) % self._modulus
        if not self._cycle_ns:
            return least if 1 <= delta <= self._jump else 0
        rounds = (passed_ns // self._cycle_ns - 1 - least) // self._modulus
        return least + self._modulus * max(0, rounds) if least else 0

    def _goes_on(self, counter: int, now_ns: int) -> bool:
        """Whether this ends a row of refused frames that count on properly."""
        apart_ns = now_ns - self._odd_ns
        in_time = (self._cycle_ns or self._usual_ns) // 2 <= apart_ns <= self._silence_ns
        follows = self._row > 0 and (counter - self._odd) % self._modulus == 1 and in_time
        self._row = self._row + 1 if follows else 1
        self._odd, self._odd_ns = counter, now_ns
        return self._row >= ROW

    def _accept(self, kind: Kind, counter: int, now_ns: int) -> Kind:
        self._last, self._last_ns, self._row = counter, now_ns, 0
        return kind


class RobotClock:
    """Turns the ticks of a clock of `bits` bits, `tick_ns` each, into ns that only rise."""

    def __init__(self, bits: int, tick_ns: float) -> None:
        self._range, self._tick_ns = 1 << bits, tick_ns
        self._last = self._odd = -1
        self._row = 0
        self._ticks = 0
        self._offset_ns = 0

    def judge(self, ticks: int, *, silent: bool) -> tuple[Kind, int]:
        """(next, restarted, repeated or old; ns). silent: nothing came for so long that the robot may have been started anew."""
        if self._last < 0:
            self._last = self._ticks = ticks
            return "next", self._now()
        delta = (ticks - self._last) % self._range
        if 0 < delta < self._range // 2:
            self._ticks += delta
            kind: Kind = "next"
        else:
            step = (ticks - self._odd) % self._range
            self._row = self._row + 1 if self._row and 0 < step < self._range // 2 else 1
            self._odd = ticks
            if self._row < ROW and not silent:
                return ("repeated" if delta == 0 else "old"), 0
            self._offset_ns += RESTART_GAP_NS
            kind = "restarted"
        self._last, self._row = ticks, 0
        return kind, self._now()

    def _now(self) -> int:
        return round(self._ticks * self._tick_ns) + self._offset_ns
