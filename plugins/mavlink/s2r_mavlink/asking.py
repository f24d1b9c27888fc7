"""What the runtime asks of the robot: messages at a rate, its time, the mode in which it can be driven, arming. And its own heartbeat.

It acts only when it is called by who knows the daemon's state (`Transport.poll`): a daemon that hangs is silent, within a second.

Rates. SET_MESSAGE_INTERVAL for one message after the other, in whole milliseconds, because that is what ArduPilot keeps; where it is denied
(ArduPilot: above 0.8 of its loop rate) the next slower one, until it is granted. What was granted is then asked for, because some accept
and do what they like. Asked again when the robot starts anew, when a ground station asked for rates of its own, when a message comes after
a gap (MAVProxy sets all rates to its own every 15 s), and when far less comes than was granted.

Mode and arming, as the profile's `take_over` says: when the robot is found, and again when a person cleared a stop. Once somebody changed
the mode or disarmed it, it is left alone. After an emergency stop, and at the end, `stop_mode`.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable
from typing import Any

from s2r_mavlink import dialect
from s2r_mavlink.door import Told
from s2r_mavlink.pose import SOURCES
from s2r_mavlink.robot_state import mode_name, mode_number
from s2r_mavlink.wire import Fields, Wire

SECOND = 1_000_000_000
HEARTBEAT_NS = SECOND
TIME_NS = SECOND // 2
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
DRIVING_NS = SECOND
GAP, GAP_LEAST_NS = 4.0, 60 * 1_000_000
"""Intervals between two of a message, above which it is asked for again."""
SETTLING_NS = SECOND
"""After a rate was granted, before gaps count: the first one may still be an old one's."""
GAPS_MOST = 3
"""In a row, before the robot is left in peace for a while: it can't, then."""
LINES_MOST = 20
SAID_AGAIN_NS = 60 * SECOND
ONBOARD_CONTROLLER, NO_AUTOPILOT = 18, 8
STANDBY, ACTIVE = 3, 4
STOPS = ("emergency_stop", "manual_override")
CUSTOM_MODE = 1.0

Send = Callable[[int, bytes], bool]


class Rate:
    """One message's interval, ms: wanted, asked for now, the slowest that was denied, the fastest that was accepted (0: none), and the one
    that is in force (0: not known yet).
    """

    def __init__(self, number: int, wanted_ms: int) -> None:
        self.number, self.wanted_ms = number, wanted_ms
        self.begin()

    def begin(self) -> None:
        """Nothing was asked yet."""
        self.asked_ms, self.denied_ms, self.accepted_ms, self.granted_ms, self.granted_ns = self.wanted_ms, 0, 0, 0.0, 0

    def next_ms(self) -> int:
        """What to ask for next: slower until something is accepted, then between that and what was denied; 0: nothing more."""
        if not self.denied_ms:
            return 0 if self.accepted_ms else self.wanted_ms
        if not self.accepted_ms:
            return max(self.denied_ms + 1, math.ceil(SLOWER * self.denied_ms))
        return (self.denied_ms + self.accepted_ms) // 2 if self.accepted_ms - self.denied_ms > 1 else 0

    @property
    def name(self) -> str:
        """The message's."""
        return dialect.MESSAGES[self.number].name


class Asking:
    """send: hands a message (number, payload) to the robot, False if it couldn't; told: messages about the pose that came, by number.

    lines: for the journal.
    """

    def __init__(self, options: dict[str, Any], wire: Wire, told: dict[int, Told], send: Send) -> None:
        self._wire, self._told, self._send = wire, told, send
        self._target = (options["system"], options["component"])
        self._mode = mode_number(options["mode"]) if options["mode"] else None
        self._stop_mode = mode_number(options["stop_mode"]) if options["stop_mode"] else None
        self._take_over = options["take_over"]
        wanted_ms = max(1, math.floor(1000.0 / options["rate"]))
        # vision comes from a sensor's own computer; an autopilot that is asked for it has none to send
        poses = () if options["pose"] == "vision" else SOURCES[options["pose"]]
        self.rates = [Rate(number, wanted_ms) for number in poses] + [Rate(dialect.HEARTBEAT, HEARTBEAT_INTERVAL_MS)]
        self.lines: deque[str] = deque(maxlen=LINES_MOST)
        self._said: dict[str, int] = {}
        self._now_ns = 0
        self._turn: Rate | None = None
        self._confirming = False
        self._asked_ns = self._heartbeat_ns = self._time_ns = self._order_ns = self._later_ns = self._count_ns = 0
        self._tries = self._orders = 0
        self._counted: dict[int, int] = {}
        self._gaps = self._gap_ns = 0
        self._restarts = self._overrides = 0
        self._may_take = self._take_over != "never" and self._mode is not None
        self._reason = ""
        self._drives = False
        self._mode_seen: int | None = None
        self._drove_ns = -DRIVING_NS

    # ------------------------------------------------------------------ what the transport tells

    def driven(self, now_ns: int) -> None:
        """A controller or the sampler drives."""
        self._drove_ns = now_ns

    def gate(self, reason: str) -> None:
        """Why the gate is closed; empty while it is open."""
        reason = reason.removeprefix("latched:")
        if self._reason in STOPS and reason not in STOPS and self._take_over != "never":
            self._may_take, self._orders = True, 0  # a person cleared the stop
        self._reason = reason

    def disturbed(self) -> None:
        """Somebody else asked the robot for rates."""
        self._begin_rates()

    # ------------------------------------------------------------------ time passes

    def tick(self, now_ns: int) -> None:
        """Called at least every 20 ms."""
        self._now_ns = now_ns
        if now_ns - self._heartbeat_ns >= HEARTBEAT_NS:
            self._heartbeat_ns = now_ns
            self.heartbeat(now_ns)
        if now_ns - self._time_ns >= TIME_NS:
            self._time_ns = now_ns
            self._send(dialect.TIMESYNC, dialect.MESSAGES[dialect.TIMESYNC].pack(0, now_ns, 0, 0))
        self._listen(now_ns)
        self._look_at_robot()
        if now_ns - self._wire.robot.heard_ns < LATER_NS and self._wire.robot.heard_ns:
            self._ask_rates(now_ns)
            self._ask_mode(now_ns)

    def heartbeat(self, now_ns: int) -> None:
        """Who we are, and whether somebody drives."""
        state = ACTIVE if now_ns - self._drove_ns < DRIVING_NS else STANDBY
        self._send(dialect.HEARTBEAT, dialect.MESSAGES[dialect.HEARTBEAT].pack(0, ONBOARD_CONTROLLER, NO_AUTOPILOT, 0, state, 3))

    def _listen(self, now_ns: int) -> None:
        heard = self._wire.heard
        while heard:
            number, fields = heard.popleft()
            if number == dialect.COMMAND_ACK:
                self._answered(fields, now_ns)
            elif number == dialect.MESSAGE_INTERVAL:
                self._interval(fields, now_ns)
            elif number == dialect.STATUSTEXT and fields[0] <= 4:  # warnings and worse
                text = fields[1].split(b"\0")[0].decode("ascii", "replace")
                self._say(f"the robot says: {text}")

    def _look_at_robot(self) -> None:
        """Notes for a person: it is ready, it was taken over, it started anew."""
        robot, restarts = self._wire.robot, self._wire.clock.restarts
        if restarts != self._restarts:
            self._restarts = restarts
            self._begin_rates()
            self._say("the robot's clock began anew")
        if robot.overrides != self._overrides:
            self._overrides, self._may_take = robot.overrides, False
            self._say(f"the robot was stopped or taken over; to go on: s2r clear, and {self._give_back()}")
        if robot.mode != self._mode_seen:  # the next order needn't wait for the last one
            self._mode_seen, self._order_ns = robot.mode, 0
        drives = robot.drives and robot.mode is not None
        if drives != self._drives:
            self._drives = drives
            if drives:
                self._may_take, self._orders = False, 0
                self._say("the robot can be driven")

    def _give_back(self) -> str:
        if self._take_over == "never":
            return f"switch it to {mode_name(self._mode)} and arm it" if self._mode is not None else "see to it that it can be driven"
        return "the runtime takes it again"

    def _say(self, line: str) -> None:
        """Once in a while, whatever happens: a robot that repeats itself must not fill the journal."""
        if self._now_ns - self._said.get(line, -SAID_AGAIN_NS) >= SAID_AGAIN_NS:
            if len(self._said) >= LINES_MOST:
                self._said.clear()
            self._said[line] = self._now_ns
            self.lines.append(line)

    def _command(self, command: int, *parameters: float) -> bool:
        values = (*parameters, *(0.0,) * (7 - len(parameters)))
        return self._send(dialect.COMMAND_LONG, dialect.MESSAGES[dialect.COMMAND_LONG].pack(*values, command, *self._target, 0))

    # ------------------------------------------------------------------ rates

    def _begin_rates(self) -> None:
        for rate in self.rates:
            rate.begin()
        self._turn, self._later_ns = None, 0

    def _ask_rates(self, now_ns: int) -> None:
        if self._turn is None:
            if now_ns >= self._later_ns:
                self._turn = next((rate for rate in self.rates if not rate.granted_ms), None)
                self._tries, self._confirming, self._asked_ns = 0, False, 0
            if self._turn is None:
                self._watch_gaps(now_ns)
                self._watch_rates(now_ns)
                return
        if now_ns - self._asked_ns < ANSWER_NS:
            return
        if self._confirming:  # it can't say what it granted
            self._grant(self._turn, self._turn.accepted_ms)
        elif self._tries >= PATIENCE:
            self._say(f"the robot doesn't answer when asked for {self._turn.name}; asked again later")
            self._turn, self._later_ns = None, now_ns + LATER_NS
        else:
            self._ask(self._turn, now_ns)

    def _ask(self, rate: Rate, now_ns: int) -> None:
        self._asked_ns, self._confirming = now_ns, False
        self._tries += 1
        self._command(dialect.SET_MESSAGE_INTERVAL, rate.number, 1000.0 * rate.asked_ms)

    def _answered(self, f: Fields, now_ns: int) -> None:
        command, result = f[0], f[1]
        if command == dialect.SET_MESSAGE_INTERVAL and self._turn is not None and not self._confirming:
            if result != dialect.IN_PROGRESS:
                self._next_rate(self._turn, result, now_ns)
        elif command in (dialect.DO_SET_MODE, dialect.COMPONENT_ARM_DISARM) and result not in (dialect.ACCEPTED, dialect.IN_PROGRESS):
            what = "change its mode" if command == dialect.DO_SET_MODE else "arm"
            self._say(f"the robot won't {what}: {_result(result)}")

    def _next_rate(self, rate: Rate, result: int, now_ns: int) -> None:
        """One interval was accepted or denied: the next one, or the question what is in force now."""
        if result == dialect.ACCEPTED:
            rate.accepted_ms = rate.asked_ms
        else:
            rate.denied_ms = rate.asked_ms
        following = rate.next_ms()
        if following > SLOWEST_MS or (result == dialect.UNSUPPORTED and not rate.accepted_ms):
            self._say(f"{rate.name}: the robot grants no rate ({_result(result)}); it comes as it may")
            rate.granted_ms, self._turn = math.inf, None
        elif following:
            rate.asked_ms, self._tries = following, 0
            self._ask(rate, now_ns)
        else:
            self._confirming, self._asked_ns = True, now_ns
            self._command(dialect.GET_MESSAGE_INTERVAL, rate.number)

    def _interval(self, f: Fields, now_ns: int) -> None:
        interval_us, number = f
        if self._turn is not None and self._confirming and number == self._turn.number:
            self._grant(self._turn, interval_us * 1e-3 if interval_us > 0 else self._turn.accepted_ms)
            self._ask_rates(now_ns)

    def _grant(self, rate: Rate, granted_ms: float) -> None:
        rate.granted_ms, rate.granted_ns, self._turn, self._confirming = granted_ms, self._now_ns, None, False
        why = f", asked for {rate.wanted_ms} ms" if granted_ms != rate.wanted_ms else ""
        self._say(f"{rate.name} every {granted_ms:g} ms{why}")

    def _watch_gaps(self, now_ns: int) -> None:
        """Whether a message that was granted came after a gap. Only that one is asked for, as it was granted."""
        for rate in self.rates:
            told = self._told.get(rate.number)
            if told is None or not 0.0 < rate.granted_ms < math.inf:
                continue
            gap_ns, told.gap_ns = told.gap_ns, 0
            if now_ns - rate.granted_ns < SETTLING_NS:
                continue
            if gap_ns > max(GAP_LEAST_NS, GAP * 1e6 * rate.granted_ms / min(1.0, self._wire.clock.pace)) and now_ns >= self._gap_ns:
                self._gaps = self._gaps + 1 if now_ns - self._gap_ns < LATER_NS else 1
                self._gap_ns = now_ns + (LATER_NS if self._gaps >= GAPS_MOST * len(self._told) else 0)
                self._say(f"{rate.name} comes less often than granted; asked for again")
                self._turn, self._tries, rate.asked_ms, rate.granted_ms = rate, 0, rate.accepted_ms or rate.wanted_ms, 0.0
                rate.denied_ms = rate.accepted_ms = 0
                self._ask(rate, now_ns)
                return

    def _watch_rates(self, now_ns: int) -> None:
        """Whether about as much comes as was granted, over a few seconds of the robot's."""
        if now_ns - self._count_ns < LATER_NS:
            return
        seconds, before = (now_ns - self._count_ns) * 1e-9 * min(1.0, self._wire.clock.pace), self._counted
        self._count_ns, self._counted = now_ns, {number: told.count for number, told in self._told.items()}
        if seconds > 1.5e-9 * LATER_NS or not before:
            return  # it was silent, or this is the first look
        for rate in self.rates:
            due = 1000.0 * seconds / rate.granted_ms if rate.granted_ms else 0.0
            if rate.number in before and self._counted[rate.number] - before[rate.number] < SPARSE * due - 2.0:
                self._say(f"{rate.name} comes less often than granted; asked for again")
                self._begin_rates()
                return

    # ------------------------------------------------------------------ mode and arming

    def _ask_mode(self, now_ns: int) -> None:
        robot = self._wire.robot
        if now_ns - self._order_ns < SECOND or robot.mode is None:
            return
        if self._reason == "emergency_stop":
            if self._stop_mode is not None and robot.armed and robot.mode == self._mode:
                self._order(now_ns, dialect.DO_SET_MODE, CUSTOM_MODE, self._stop_mode)
        elif self._may_take and self._reason not in STOPS and not robot.drives:
            if robot.mode != self._mode:
                self._order(now_ns, dialect.DO_SET_MODE, CUSTOM_MODE, float(self._mode or 0))
            elif self._take_over == "arm":
                self._order(now_ns, dialect.COMPONENT_ARM_DISARM, 1.0)

    def _order(self, now_ns: int, command: int, *parameters: float) -> None:
        """More and more seldom, if it doesn't help: pre-arm checks take a while."""
        self._orders += 1
        self._order_ns = now_ns + min(self._orders // PATIENCE, 4) * SECOND
        self._command(command, *parameters)

    def leave(self) -> None:
        """The runtime ends: what it took over it puts aside."""
        if self._stop_mode is not None and self._wire.robot.drives and self._wire.robot.mode is not None:
            self._command(dialect.DO_SET_MODE, CUSTOM_MODE, self._stop_mode)


def _result(number: int) -> str:
    return dialect.RESULTS[number] if number < len(dialect.RESULTS) else f"result {number}"
