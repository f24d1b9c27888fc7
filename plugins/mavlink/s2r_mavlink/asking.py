"""What the runtime asks of the robot: rates (`Rates`), its time, the mode in which it can be driven, arming. And its own heartbeat.

It acts only when it is called by who knows the daemon's state (`Transport.poll`): a daemon that hangs is silent, within a second.

Mode and arming, as the profile's `take_over` says: when the robot is found, and again when a person cleared a stop. Once somebody changed
the mode or disarmed it, it is left alone. After an emergency stop, and at the end, `stop_mode`; with `stop_when = "closed"` also while the
gate is closed for a reason that is not where the robot is or how it is seen (those go by themselves, and zero velocity stops it).
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from s2r_mavlink import dialect
from s2r_mavlink.door import Told
from s2r_mavlink.journal import Journal
from s2r_mavlink.rates import LATER_NS, PATIENCE, Rates
from s2r_mavlink.robot_state import mode_name, mode_number
from s2r_mavlink.wire import Fields, Wire

SECOND = 1_000_000_000
HEARTBEAT_NS = SECOND
TIME_NS = SECOND // 4
DRIVING_NS = SECOND
WARNING = 4
ONBOARD_CONTROLLER, NO_AUTOPILOT = 18, 8
STANDBY, ACTIVE = 3, 4
CUSTOM_MODE = 1.0
STOPS = ("emergency_stop", "manual_override")
PASSES = ("no_controller", "settling", "observation_invalid")
"""Reasons of the gate that come after all that set the robot aside: nothing but the robot's own mode stands in the way any more."""
ASIDE = frozenset((
    "recorder_down", "controller_fault", "verification_running", "analytics_down", "watch_alarm", "certificate_revoked", "no_certificate",
    "certificate_expired", "digest_mismatch", "radius_above_verified", "measurement_faults", "command_invalid",
))  # fmt: skip
"""Reasons for which an open gate that closes sets it aside."""

Send = Callable[[int, bytes], bool]


class Asking:
    """send: hands a message (number, payload) to the robot, False if it couldn't; told: messages about the pose that came, by number."""

    def __init__(self, options: dict[str, Any], wire: Wire, told: dict[int, Told], send: Send) -> None:
        self._wire, self._send, self.journal = wire, send, Journal()
        self.rates = Rates(options["pose"], options["rate"], wire.clock, told, self._command, self.journal)
        self._target = (options["system"], options["component"])
        self._mode = mode_number(options["mode"]) if options["mode"] else None
        self._stop_mode = mode_number(options["stop_mode"]) if options["stop_mode"] else None
        self._take_over, self._stop_when = options["take_over"], options["stop_when"]
        self._may_take = self._take_over != "never" and self._mode is not None
        self._was_open = self._aside = self._drives = False
        self._reason = ""
        self._mode_seen: int | None = None
        self._heartbeat_ns = self._time_ns = self._order_ns = self._orders = 0
        self._restarts = self._overrides = 0
        self._drove_ns = -DRIVING_NS

    # ------------------------------------------------------------------ what the transport tells

    def driven(self, now_ns: int) -> None:
        """A controller or the sampler drives."""
        self._drove_ns = now_ns

    def gate(self, reason: str) -> None:
        """Why the gate is closed; empty while it is open."""
        self._look_at_robot()  # first what it did: a stop that is looked at only after it was cleared would hold for good
        reason = reason.removeprefix("latched:")
        if self._reason in STOPS and reason not in STOPS and self._take_over != "never":
            self._may_take, self._orders = True, 0  # a person cleared the stop
        self._reason = reason
        if reason in ASIDE and self._was_open and self._stop_when == "closed":
            self._aside = True
        elif self._aside and (reason in PASSES or not reason):
            self._aside, self._may_take, self._orders = False, self._take_over != "never", 0
        self._was_open = not reason or (self._was_open and reason != "no_controller")

    # ------------------------------------------------------------------ time passes

    def tick(self, now_ns: int) -> None:
        """Called at least every 20 ms."""
        self.journal.now_ns = now_ns
        if now_ns - self._heartbeat_ns >= HEARTBEAT_NS:
            self._heartbeat_ns = now_ns
            self._beat(now_ns)
        if now_ns - self._time_ns >= TIME_NS:
            self._time_ns = now_ns
            self._send(dialect.TIMESYNC, dialect.MESSAGES[dialect.TIMESYNC].pack(0, now_ns, 0, 0))
        self._listen(now_ns)
        self._look_at_robot()
        if now_ns - self._wire.robot.heard_ns < LATER_NS and self._wire.robot.heard_ns:
            self.rates.tick(now_ns)
            self._ask_mode(now_ns)

    def _beat(self, now_ns: int) -> None:
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
                self.rates.interval(fields[0], fields[1], now_ns)
            elif number == dialect.STATUSTEXT and fields[0] <= WARNING:
                text = fields[1].split(b"\0")[0].decode("ascii", "replace")
                self.journal.say(f"the robot says: {text}")

    def _answered(self, f: Fields, now_ns: int) -> None:
        command, result = f[0], f[1]
        if command == dialect.SET_MESSAGE_INTERVAL:
            self.rates.answered(result, now_ns)
        elif command in (dialect.DO_SET_MODE, dialect.COMPONENT_ARM_DISARM) and result not in (dialect.ACCEPTED, dialect.IN_PROGRESS):
            what = "change its mode" if command == dialect.DO_SET_MODE else "arm"
            self.journal.say(f"the robot won't {what}: {dialect.result(result)}")

    def _look_at_robot(self) -> None:
        """Notes for a person: it is ready, it was taken over, it started anew."""
        robot, restarts = self._wire.robot, self._wire.clock.restarts
        if restarts != self._restarts:
            self._restarts = restarts
            self.rates.begin()
            self.journal.say("the robot's clock began anew")
        if robot.overrides != self._overrides:
            self._overrides, self._may_take = robot.overrides, False
            self.journal.say(f"the robot was stopped or taken over; to go on: s2r clear, and {self._give_back()}")
        if robot.mode != self._mode_seen:  # the next order needn't wait for the last one
            self._mode_seen, self._order_ns = robot.mode, 0
        drives = robot.drives and robot.mode is not None
        if drives != self._drives:
            self._drives = drives
            if drives:
                self._may_take, self._orders = False, 0
                self.journal.say("the robot can be driven")

    def _give_back(self) -> str:
        if self._take_over == "never":
            return f"switch it to {mode_name(self._mode)} and arm it" if self._mode is not None else "see to it that it can be driven"
        return "the runtime takes it again"

    def _command(self, command: int, *parameters: float) -> bool:
        values = (*parameters, *(0.0,) * (7 - len(parameters)))
        return self._send(dialect.COMMAND_LONG, dialect.MESSAGES[dialect.COMMAND_LONG].pack(*values, command, *self._target, 0))

    # ------------------------------------------------------------------ mode and arming

    def _ask_mode(self, now_ns: int) -> None:
        robot = self._wire.robot
        if now_ns - self._order_ns < SECOND or robot.mode is None:
            return
        if self._reason == "emergency_stop" or (self._aside and self._reason not in STOPS):
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
