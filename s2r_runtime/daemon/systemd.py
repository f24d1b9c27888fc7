"""Talks to systemd: ready, watchdog, status, stopping (sd_notify(3)), with the standard library alone.

A watchdog ping from a thread of its own would say that the process exists; sent from the main loop it says that the loop turns.
"""

from __future__ import annotations

import os
import socket

from s2r_runtime.daemon.every import Every


def to_journal() -> bool:
    """Whether stderr is the journal's (systemd.exec(5), JOURNAL_STREAM), and so kept where nobody who changes the log can reach it."""
    try:
        found = os.fstat(2)
    except OSError:
        return False
    return os.environ.get("JOURNAL_STREAM") == f"{found.st_dev}:{found.st_ino}"


class Notifier:
    """Sends state to the service manager, if one asked for it; without one every call does nothing.

    environment: `NOTIFY_SOCKET`, and `WATCHDOG_USEC` with `WATCHDOG_PID` where pings are expected from this process.
    """

    def __init__(self, environment: dict[str, str] | None = None) -> None:
        env = dict(os.environ) if environment is None else environment
        self._address = env.get("NOTIFY_SOCKET", "")
        self._socket: socket.socket | None = None
        self._status = ""
        self.watchdog_ns = _watchdog_ns(env)
        self._ping = Every(self.watchdog_ns // 2)
        if self._address.startswith("@"):
            self._address = "\0" + self._address[1:]  # abstract namespace
        if self._address:
            self._socket = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM | socket.SOCK_CLOEXEC)
            self._socket.setblocking(False)

    def ready(self, status: str = "") -> None:
        """The daemon serves: whoever waits for the unit goes on."""
        self._send("READY=1" + (f"\nSTATUS={status}" if status else ""))

    def status(self, text: str) -> None:
        """One line for `systemctl status`; sent when it changed."""
        if text != self._status:
            self._status = text
            self._send(f"STATUS={text}")

    def alive(self, now_ns: int) -> None:
        """Called on every turn of the loop; pings twice per watchdog period. now_ns: host's monotonic clock."""
        if self.watchdog_ns and self._ping.due(now_ns):
            self._send("WATCHDOG=1")

    def stopping(self) -> None:
        """The daemon is on its way out."""
        self._send("STOPPING=1")

    def close(self) -> None:
        """Frees the socket; may be called twice."""
        if self._socket is not None:
            self._socket.close()
            self._socket = None

    def _send(self, text: str) -> None:
        if self._socket is None:
            return
        try:
            self._socket.sendto(text.encode(), self._address)
        except OSError:
            # a manager that is gone or slow must not stop a robot's gate; the watchdog then does its work
            return


def _watchdog_ns(env: dict[str, str]) -> int:
    """Watchdog period in ns; 0 where none is set or it is meant for another process."""
    period, pid = env.get("WATCHDOG_USEC", ""), env.get("WATCHDOG_PID", "")
    if not period.isdigit() or (pid.isdigit() and int(pid) != os.getpid()):
        return 0
    return int(period) * 1000
