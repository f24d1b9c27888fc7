"""Asks the robot for messages at a rate, finds the fastest that it grants, and notices when somebody changes it.

SET_MESSAGE_INTERVAL for one message after the other, in whole milliseconds, because that is what ArduPilot keeps. Where it is denied
(ArduPilot: above 0.8 of its loop rate), slower ones until one is accepted, then between that and what was denied. What is in force is
asked for in the end, because some accept and do what they like. Asked again when the robot starts anew, when a ground station asked for
rates of its own, when a message comes after a gap (MAVProxy sets all rates to its own every 15 s), and when far less comes than granted.
"""

from __future__ import annotations

import math
from collections.abc import Callable

from s2r_mavlink import dialect
from s2r_mavlink.clock import RobotClock
from s2r_mavlink.door import Told
from s2r_mavlink.journal import Journal
from s2r_mavlink.pose import SOURCES

SECOND = 1_000_000_000
ANSWER_NS = 300 * 1_000_000
"""Until a question is asked again."""
PATIENCE = 5
"""Unanswered questions after which a message is left for later."""
LATER_NS = 5 * SECOND
HEARTBEAT_INTERVAL_MS = 200
"""How fast a change of mode is seen; a robot that doesn't grant it is seen within its second."""
SLOWEST_MS = 1000
SLOWER = 1.25
SPARSE = 0.6
"""Of what was granted: below it the rates are asked for again. A simulator that can't keep up asks for nothing else."""
GAP, GAP_LEAST_NS = 4.0, 60 * 1_000_000
"""Intervals between two of a message, above which it is asked for again."""
SETTLING_NS = SECOND
"""After a rate was granted, before gaps count: the first one may still be an old one's."""
GAPS_MOST = 3
"""In a row, before the robot is left in peace for a while: it can't, then."""

Command = Callable[..., bool]


class Rate:
    """One message's interval, ms: wanted, asked for now, the slowest that was denied, the fastest that was accepted (0: none), and the one
    that is in force (0: not known yet).
    """

    def __init__(self, number: int, wanted_ms: int) -> None:
        self.number, self.wanted_ms = number, wanted_ms
        self.begin(wanted_ms)

    def begin(self, asked_ms: int) -> None:
        """Nothing is known; this is to be asked for first."""
        self.asked_ms, self.denied_ms, self.accepted_ms, self.granted_ms, self.granted_ns = asked_ms, 0, 0, 0.0, 0

    def next_ms(self) -> int:
        """What to ask for next: slower until something is accepted, then between that and what was denied; 0: nothing more."""
        if not self.denied_ms:
            return 0
        if not self.accepted_ms:
            return max(self.denied_ms + 1, math.ceil(SLOWER * self.denied_ms))
        return (self.denied_ms + self.accepted_ms) // 2 if self.accepted_ms - self.denied_ms > 1 else 0

    @property
    def name(self) -> str:
        """The message's."""
        return dialect.MESSAGES[self.number].name


class Rates:
    """told: messages about the pose that came, by number. command: sends a COMMAND_LONG to the robot (its number, its parameters)."""

    def __init__(self, pose: str, hz: float, clock: RobotClock, told: dict[int, Told], command: Command, journal: Journal) -> None:
        self._clock, self._told, self._command, self._journal = clock, told, command, journal
        wanted_ms = max(1, math.floor(1000.0 / hz))
        # vision comes from a sensor's own computer; an autopilot that is asked for it has none to send
        numbers = () if pose == "vision" else SOURCES[pose]
        self.all = [Rate(number, wanted_ms) for number in numbers] + [Rate(dialect.HEARTBEAT, HEARTBEAT_INTERVAL_MS)]
        self._turn: Rate | None = None
        self._confirming = False
        self._asked_ns = self._later_ns = self._count_ns = self._gap_ns = 0
        self._tries = self._gaps = 0
        self._counted: dict[int, int] = {}

    def begin(self) -> None:
        """All are asked for anew."""
        for rate in self.all:
            rate.begin(rate.wanted_ms)
        self._turn, self._later_ns = None, 0

    def tick(self, now_ns: int) -> None:
        """Called at least every 20 ms while the robot is heard."""
        if self._turn is None:
            if now_ns >= self._later_ns:
                self._turn = next((rate for rate in self.all if not rate.granted_ms), None)
                self._tries, self._confirming, self._asked_ns = 0, False, 0
            if self._turn is None:
                self._watch_gaps(now_ns)
                self._watch_counts(now_ns)
                return
        if now_ns - self._asked_ns < ANSWER_NS:
            return
        if self._confirming:  # it can't say what it granted
            self._grant(self._turn, self._turn.accepted_ms, now_ns)
        elif self._tries >= PATIENCE:
            self._journal.say(f"the robot doesn't answer when asked for {self._turn.name}; asked again later")
            self._turn, self._later_ns = None, now_ns + LATER_NS
        else:
            self._ask(self._turn, now_ns)

    def _ask(self, rate: Rate, now_ns: int) -> None:
        self._asked_ns, self._confirming = now_ns, False
        self._tries += 1
        self._command(dialect.SET_MESSAGE_INTERVAL, rate.number, 1000.0 * rate.asked_ms)

    # ------------------------------------------------------------------ answers

    def answered(self, result: int, now_ns: int) -> None:
        """The robot accepted or denied the interval that it was asked for last; it doesn't say which, so they are asked for in turns."""
        rate = self._turn
        if rate is None or self._confirming or result == dialect.IN_PROGRESS:
            return
        if result == dialect.ACCEPTED:
            rate.accepted_ms = rate.asked_ms
        else:
            rate.denied_ms = rate.asked_ms
        following = rate.next_ms()
        if following > SLOWEST_MS or (result == dialect.UNSUPPORTED and not rate.accepted_ms):
            self._journal.say(f"{rate.name}: the robot grants no rate ({dialect.result(result)}); it comes as it may")
            rate.granted_ms, self._turn = math.inf, None
        elif following:
            rate.asked_ms, self._tries = following, 0
            self._ask(rate, now_ns)
        else:
            self._confirming, self._asked_ns = True, now_ns
            self._command(dialect.GET_MESSAGE_INTERVAL, rate.number)

    def interval(self, interval_us: int, number: int, now_ns: int) -> None:
        """MESSAGE_INTERVAL: what is in force."""
        if self._turn is not None and self._confirming and number == self._turn.number:
            self._grant(self._turn, interval_us * 1e-3 if interval_us > 0 else self._turn.accepted_ms, now_ns)
            self.tick(now_ns)

    def _grant(self, rate: Rate, granted_ms: float, now_ns: int) -> None:
        rate.granted_ms, rate.granted_ns, self._turn, self._confirming = granted_ms, now_ns, None, False
        why = f", asked for {rate.wanted_ms} ms" if granted_ms != rate.wanted_ms else ""
        self._journal.say(f"{rate.name} every {granted_ms:g} ms{why}")

    # ------------------------------------------------------------------ what comes

    def _watch_gaps(self, now_ns: int) -> None:
        """Whether a message that was granted came after a gap, or fails to come. Only that one is asked for, as it was granted: if it is
        the link that is silent, asking costs nothing.
        """
        for rate in self.all:
            told = self._told.get(rate.number)
            if told is None or not 0.0 < rate.granted_ms < math.inf:
                continue
            gap_ns, told.gap_ns = max(told.gap_ns, now_ns - told.newest_ns), 0
            most_ns = max(GAP_LEAST_NS, GAP * 1e6 * rate.granted_ms / min(1.0, self._clock.pace))
            if gap_ns > most_ns and now_ns - rate.granted_ns >= SETTLING_NS and now_ns >= self._gap_ns:
                self._gaps = self._gaps + 1 if now_ns - self._gap_ns < LATER_NS else 1
                self._gap_ns = now_ns + (LATER_NS if self._gaps >= GAPS_MOST * len(self._told) else 0)
                self._journal.say(f"{rate.name} comes less often than granted; asked for again")
                rate.begin(rate.accepted_ms or rate.wanted_ms)
                self._turn, self._tries = rate, 0
                self._ask(rate, now_ns)
                return

    def _watch_counts(self, now_ns: int) -> None:
        """Whether about as much comes as was granted, over a few seconds of the robot's."""
        if now_ns - self._count_ns < LATER_NS:
            return
        seconds, before = (now_ns - self._count_ns) * 1e-9 * min(1.0, self._clock.pace), self._counted
        self._count_ns, self._counted = now_ns, {number: told.count for number, told in self._told.items()}
        if seconds > 1.5e-9 * LATER_NS or not before:
            return  # it was silent, or this is the first look
        for rate in self.all:
            due = 1000.0 * seconds / rate.granted_ms if rate.granted_ms else 0.0
            if rate.number in before and self._counted[rate.number] - before[rate.number] < SPARSE * due - 2.0:
                self._journal.say(f"{rate.name} comes less often than granted; asked for again")
                self.begin()
                return
