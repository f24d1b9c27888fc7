"""What the robot says about itself: mode, armed or not, how it is. And what follows: may it be driven, did somebody take it over.

It can be driven while its heartbeats are fresh, its mode is the one in which it takes velocity commands, and it is armed. Otherwise its
observations carry a fault: a robot that doesn't obey would be measured as one whose model is wrong.

A person takes over by changing the mode or disarming; that stops everything until a person clears it. A change to the profile's `stop_mode`
that the robot confirmed to us (COMMAND_ACK with our ids) a moment before is our own doing.
"""

from __future__ import annotations

from typing import Any

from s2r_mavlink.dialect import ACCEPTED, DO_SET_MODE
from s2r_runtime.messages import OverrideChanged

SECOND = 1_000_000_000
HEARTBEAT_OLD_NS = 3 * SECOND
OWN_DOING_NS = 3 * SECOND
ARMED = 0x80
CRITICAL, EMERGENCY = 5, 6
"""MAV_STATE: a fail-safe acts; mayday, and above it power off and flight termination."""
STATES = ("uninitialised", "booting", "calibrating", "standby", "active", "critical", "emergency", "power off", "terminated")

ROVER_MODES = {
    "MANUAL": 0, "ACRO": 1, "STEERING": 3, "HOLD": 4, "LOITER": 5, "FOLLOW": 6, "SIMPLE": 7, "DOCK": 8, "CIRCLE": 9, "AUTO": 10,
    "RTL": 11, "SMART_RTL": 12, "GUIDED": 15, "INITIALISING": 16,
}  # fmt: skip
"""ArduPilot Rover's (and Boat's) numbers. Other vehicles: the profile gives the number."""


def mode_number(text: str) -> int | None:
    """A mode of ArduPilot Rover by name, or any by number; None for neither."""
    if text.isdecimal() and int(text) < 1 << 32:
        return int(text)
    return ROVER_MODES.get(text.upper())


def mode_name(number: int) -> str:
    """Its name, or its number."""
    return next((name for name, value in ROVER_MODES.items() if value == number), f"mode {number}")


class RobotState:
    """wanted: the number of the mode in which it can be driven; None: it has no modes, and is always ready. stop: of `stop_mode`."""

    def __init__(self, wanted: int | None, stop: int | None) -> None:
        self._wanted, self._stop = wanted, stop
        self.mode: int | None = None
        self.armed = False
        self.status = 0
        self.heard_ns = 0
        self.overrides = 0
        self._own_ns: int | None = None

    @property
    def drives(self) -> bool:
        """Whether it obeyed velocity commands when it was last heard."""
        return self._wanted is None or (self.mode == self._wanted and self.armed)

    def heartbeat(self, f: tuple[Any, ...], now_ns: int) -> list[OverrideChanged]:
        """One HEARTBEAT of its autopilot."""
        drove, was = self.drives and self.mode is not None, self.status
        self.mode, self.armed, self.status, self.heard_ns = f[0], bool(f[3] & ARMED), f[4], now_ns
        stops: list[OverrideChanged] = []
        if self.status >= CRITICAL and self.status != was and (drove or self.status >= EMERGENCY):
            state = STATES[self.status] if self.status < len(STATES) else f"in state {self.status}"
            stops.append(OverrideChanged(now_ns, "emergency_stop", f"the robot says that it is {state}"))
        own = self.mode == self._stop and self.armed and self._own_ns is not None and now_ns - self._own_ns <= OWN_DOING_NS
        if drove and not self.drives and not own:
            stops.append(OverrideChanged(now_ns, "manual_override", f"the robot was taken over: {self._manner()}"))
        if self.drives:
            self._own_ns = None
        self.overrides += len(stops)
        return stops

    def answer(self, command: int, result: int, now_ns: int) -> None:
        """COMMAND_ACK to a command of ours."""
        if command == DO_SET_MODE and result == ACCEPTED:
            self._own_ns = now_ns

    def restarted(self, now_ns: int) -> list[OverrideChanged]:
        """Its clock began anew: nothing is known of it. A robot that is switched off while it drives is not driven on unasked."""
        drove = self._wanted is not None and self.mode is not None and self.drives
        self.mode, self.armed, self.status, self.heard_ns, self._own_ns = None, False, 0, 0, None
        self.overrides += drove
        return [OverrideChanged(now_ns, "manual_override", "the robot started anew while it was driven")] if drove else []

    def fault(self, now_ns: int) -> str:
        """Why it can't be driven now, or empty."""
        if self._wanted is None:
            return ""
        if self.mode is None or now_ns - self.heard_ns > HEARTBEAT_OLD_NS:
            return "no heartbeat of the robot"
        return "" if self.drives else f"the robot can't be driven: {self._manner()}"

    def _manner(self) -> str:
        mode = "no mode" if self.mode is None else mode_name(self.mode)
        return f"{mode}, {'armed' if self.armed else 'disarmed'}"
