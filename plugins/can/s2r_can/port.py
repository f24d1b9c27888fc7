"""One interface of python-can: opened, listened to in a thread, opened anew when it fails, and sent to without waiting.

Found out on python-can 4.6 and held by tests:
- a socketcand connection that its server closed reads as an endless silence at full speed, and connecting to nobody as ten seconds of
  the same: so somebody looks whether the server is there, before and after;
- over socketcand, frames that follow each other wait up to 40 ms for the acknowledgement of the first, unless `tcp_tune` is set;
- some drivers give back what was sent, marked as such; udp_multicast does so unmarked, whatever `receive_own_messages` says: each frame of
  ours is taken out once;
- one datagram that is no CAN frame raises; it is counted, and the next one read;
- `send` blocks on sockets and serial lines: those get a thread of their own, and a short queue;
- log messages go to stderr unless somebody says otherwise.
"""

from __future__ import annotations

import contextlib
import logging
import queue
import socket
import struct
import threading
import time
from collections import deque
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

from s2r_can.records import ERROR, EXTENDED, FD, INDICATOR, PAYLOAD_MAX, REMOTE, SWITCH, Record
from s2r_runtime.errors import ConfigError

if TYPE_CHECKING:
    import can

LISTEN_S = 0.1
"""How long the thread listens before it looks whether it is to end."""
AGAIN_S = 0.2
"""Between two attempts to open: a link that is back is used within half a second."""
ERRORS_S, ERRORS_FAST = 0.5, 100
"""An interface that has given nothing but errors for so long is opened anew; after so many in a row they are read more slowly."""
PROMPT = ("socketcan", "udp_multicast", "virtual")
"""Interfaces whose `send` does not wait when it is told not to, and whose stamps are this host's clock (wall time)."""
ECHOING = ("udp_multicast",)
ECHO_S, ECHOES = 1.0, 256
WRITING = 16
"""Frames that wait for a slow interface; the oldest give way, as an old command is worse than none."""


class Port:
    """One bus. config: python-can's settings. take: called from this port's thread with every frame that came, and its arrival (ns)."""

    def __init__(
        self, side: str, config: dict[str, Any], take: Callable[[Record], None], filters: list[dict[str, Any]] | None = None
    ) -> None:
        self._side, self._config, self._take, self._filters = side, config, take, filters
        self.trouble = ""
        """Why nothing can be heard or sent; empty while the interface works."""
        self._failing: tuple[float, float, str] = (0.0, 0.0, "")
        self._counts = dict.fromkeys(("received", "sent", "dropped", "errors", "opened"), 0)
        self._bus: can.BusABC | None = None
        self._ending = threading.Event()
        self._threads: list[threading.Thread] = []
        self._writing: queue.SimpleQueue[Record | None] = queue.SimpleQueue()
        self._echoes: dict[tuple[int, bytes], deque[float]] = {}
        self._lock = threading.Lock()
        self._last_ns = 0
        self._prompt = config["interface"] in PROMPT

    # ------------------------------------------------------------------ life

    def open(self) -> None:
        """Begins to open and to listen. Raises ConfigError for an interface that python-can doesn't have."""
        import can

        logging.getLogger("can").setLevel(logging.CRITICAL)
        name = self._config["interface"]
        try:
            can.interface._get_class_for_interface(name)
        except (NotImplementedError, ImportError, can.CanError) as error:
            known = ", ".join(sorted(can.VALID_INTERFACES))
            raise ConfigError(f"transport.{self._side}.interface {name!r} cannot be used: {error}; python-can has: {known}") from None
        self._ending.clear()
        self._start(self._listen, "listens")
        if not self._prompt:
            self._writing = queue.SimpleQueue()
            self._start(self._write, "writes")

    def _start(self, run: Callable[[], None], what: str) -> None:
        thread = threading.Thread(target=run, name=f"can-{self._side}-{what}", daemon=True)
        self._threads.append(thread)
        thread.start()

    def close(self) -> None:
        """Ends the threads; may be called twice. One that hangs in a driver is left behind."""
        self._ending.set()
        self._writing.put(None)
        threads, self._threads = self._threads, []
        for thread in threads:
            thread.join(2.0)

    def refuses(self, seconds: float) -> str:
        """Why nothing that was sent in so many seconds was taken; empty where something was, or nothing was sent."""
        first, last, why = self._failing
        return f"{self._named()} takes no frames: {why}" if first and last - first > seconds > time.monotonic() - last else ""

    @property
    def counts(self) -> dict[str, int]:
        """sent + dropped is what was handed to `send`, at every instant: what waits counts as sent until it turns out otherwise."""
        with self._lock:
            return dict(self._counts)

    # ------------------------------------------------------------------ in

    def _listen(self) -> None:
        while not self._ending.is_set():
            try:
                bus = self._opened()
            except Exception as error:  # noqa: BLE001 - drivers raise what they like; it is tried again
                self.trouble = f"{self._named()} cannot be opened: {_said(error)}"
                self._ending.wait(AGAIN_S)
                continue
            self._bus, self.trouble = bus, ""
            self._counts["opened"] += 1
            try:
                self._hear(bus)
            except Exception as error:  # noqa: BLE001 - as above
                self.trouble = f"{self._named()} failed: {_said(error)}"
            finally:
                self._bus = None
                with contextlib.suppress(Exception):  # a driver that broke may break here again
                    bus.shutdown()
            self._ending.wait(0.0 if self._ending.is_set() else 0.05)

    def _opened(self) -> can.BusABC:
        import can

        if self._config["interface"] == "socketcand":
            with socket.create_connection((self._config.get("host"), self._config.get("port")), timeout=0.5):
                pass
        more: dict[str, Any] = {"ignore_config": True}
        if self._config["interface"] == "socketcan" and self._filters:
            more["can_filters"] = self._filters
        if self._config["interface"] == "socketcand":
            more["tcp_tune"] = True
        bus = can.Bus(**{**more, **self._config})
        connection = _connection(bus)
        if connection is not None:
            connection.setsockopt(socket.SOL_SOCKET, socket.SO_SNDTIMEO, struct.pack("@ll", 0, round(LISTEN_S * 1e6)))
        return bus

    def _hear(self, bus: can.BusABC) -> None:
        """Until the port is closed. Raises what the driver raises when it is of no use any more."""
        failed, good_at = 0, time.monotonic()
        while not self._ending.is_set():
            try:
                message = bus.recv(LISTEN_S)
                record = None if message is None else self._record(message)
            except Exception:  # bytes that are no frame, or a driver that broke
                failed += 1
                self._counts["errors"] += 1
                if time.monotonic() - good_at > ERRORS_S:
                    raise
                if failed > ERRORS_FAST:
                    self._ending.wait(0.001)
                continue
            failed, good_at = 0, time.monotonic()
            if message is None or record is None:
                if _hung_up(bus):
                    raise ConnectionError("the other end closed the connection")
                continue
            if message.is_rx and not self._own(record):
                self._counts["received"] += 1
                self._take(record)

    def _record(self, message: can.Message) -> Record:
        """Its record. Raises what a message raises that is no CAN frame, whatever driver made it."""
        payload = b"" if message.is_remote_frame and not message.is_error_frame else bytes(message.data)
        if len(payload) > PAYLOAD_MAX:
            raise ValueError(f"{len(payload)} bytes are no CAN frame")
        now_ns = time.monotonic_ns()
        if self._prompt:  # the kernel stamped it when it came; this thread may be late
            late = time.time() - message.timestamp
            if 0.0 < late < LISTEN_S:
                now_ns -= int(late * 1e9)
        self._last_ns = now_ns = max(now_ns, self._last_ns + 1)
        key = message.arbitration_id & 0x1FFFFFFF
        if message.is_error_frame:
            return Record(now_ns, key | ERROR, 0, payload)
        key |= (EXTENDED if message.is_extended_id else 0) | (REMOTE if message.is_remote_frame else 0)
        flags = (
            (FD if message.is_fd else 0) | (SWITCH if message.bitrate_switch else 0) | (INDICATOR if message.error_state_indicator else 0)
        )
        return Record(now_ns, key, flags, payload)

    def _own(self, record: Record) -> bool:
        """Whether this is the echo of a frame that was sent here; each is taken for one once."""
        if not self._echoes:
            return False
        frame = (record.key, record.payload)
        with self._lock:
            sent = self._echoes.get(frame)
            while sent and sent[0] < time.monotonic() - ECHO_S:
                sent.popleft()
            if sent:
                sent.popleft()
                return True
            self._echoes.pop(frame, None)
            return False

    # ------------------------------------------------------------------ out

    def send(self, record: Record) -> bool:
        """Hands a frame to the interface; never waits. False (and counted) if it was dropped."""
        if self._bus is None:
            self._count(dropped=1)
            return False
        if self._prompt:
            return self._put(record)
        self._count(sent=1)  # until it turns out otherwise: what waits or is in hand must not be missing from the sum
        self._writing.put(record)
        while self._writing.qsize() > WRITING:
            with contextlib.suppress(queue.Empty):
                self._writing.get_nowait()
                self._count(sent=-1, dropped=1)
        return True

    def _write(self) -> None:
        writing = self._writing
        while True:
            record = writing.get()
            if record is None:
                return
            if self._ending.is_set() or not self._handed_over(record):
                self._count(sent=-1, dropped=1)

    def _put(self, record: Record) -> bool:
        taken = self._handed_over(record)
        self._count(sent=int(taken), dropped=int(not taken))
        return taken

    def _handed_over(self, record: Record) -> bool:
        """Whether the interface took it."""
        bus = self._bus
        try:
            if bus is None:
                raise ConnectionError("not open")
            if self._config["interface"] in ECHOING:
                self._expect_echo(record)
            bus.send(_message(record), timeout=0.0 if self._prompt else LISTEN_S)
        except Exception as error:  # noqa: BLE001 - a full buffer, a cable, a driver: the robot's time-out and ours deal with it
            now = time.monotonic()
            self._failing = (self._failing[0] or now, now, _said(error))
            connection = _connection(bus)
            if connection is not None:  # half a line may have left: whatever followed it would be read wrong
                with contextlib.suppress(OSError):
                    connection.shutdown(socket.SHUT_RDWR)
            return False
        self._failing = (0.0, 0.0, "")
        return True

    def _count(self, *, sent: int = 0, dropped: int = 0) -> None:
        with self._lock:
            self._counts["sent"] += sent
            self._counts["dropped"] += dropped

    def _expect_echo(self, record: Record) -> None:
        now = time.monotonic()
        with self._lock:
            self._echoes.setdefault((record.key, record.payload), deque()).append(now)
            if len(self._echoes) > ECHOES:
                self._echoes = {frame: sent for frame, sent in self._echoes.items() if sent and sent[-1] >= now - ECHO_S}

    def _named(self) -> str:
        return f"{self._side} side: {self._config['interface']} {self._config.get('channel', '')}".rstrip()


def _message(record: Record) -> can.Message:
    import can

    return can.Message(
        arbitration_id=record.key & 0x1FFFFFFF,
        is_extended_id=bool(record.key & EXTENDED),
        is_remote_frame=bool(record.key & REMOTE),
        is_fd=bool(record.flags & FD),
        bitrate_switch=bool(record.flags & SWITCH),
        data=record.payload,
    )


def _said(error: Exception) -> str:
    return " ".join(str(error).split())[:160] or type(error).__name__


def _connection(bus: can.BusABC | None) -> socket.socket | None:
    """The socket of a socketcand client, which it does not give out."""
    return getattr(bus, "_SocketCanDaemonBus__socket", None)


def _hung_up(bus: can.BusABC) -> bool:
    """Whether a socketcand server closed the connection, which its `recv` takes for silence."""
    connection = _connection(bus)
    if connection is None:
        return False
    try:
        return bool(connection.recv(1, socket.MSG_PEEK | socket.MSG_DONTWAIT) == b"")
    except BlockingIOError:
        return False
    except OSError:
        return True
