"""A robot on a Unix datagram socket, its transport, and a daemon that knows that transport: quick to start, no network.

Run as processes of their own:
    python loop_robot.py robot DIR [--realtime] [--dt S] [--gain G]          a unicycle that notes what it was told in DIR/applied.jsonl
    python loop_robot.py daemon PROFILE --state DIR --log DIR [--seed N]     the real daemon, with the transport `loop` registered
    python loop_robot.py campaign PROFILE OUT --state DIR                    one campaign, as `s2r sample` runs it
    python loop_robot.py s2r VERB ...                                        any verb of the command line

In lockstep the robot publishes observation k, waits for the command that answers it, integrates one period and goes on; it
repeats the observation every 0.1 s while it waits. In real time it publishes every dt and applies the newest command while its
time to live lasts.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import math
import os
import random
import select
import signal
import socket
import sys
import time
from collections import deque
from collections.abc import Callable
from pathlib import Path
from typing import Any, ClassVar

from s2r_runtime.hookspecs import Offer, hookimpl
from s2r_runtime.messages import Command, Decided, Frame, GateChanged, LinkChanged, Observation, OverrideChanged

LINK_LOST_NS = 1_000_000_000
ROBOT, DAEMON = "robot.sock", "daemon.sock"


def sabotage(sabotage: str, value: float = 0.0) -> None:
    """What no datagram could do: the process in which the transport lives is changed from within. value 0 undoes it."""
    import ctypes
    import threading

    if sabotage == "recorder dead":
        for thread in threading.enumerate():
            if thread.name == "recorder" and thread.ident is not None:
                ctypes.pythonapi.PyThreadState_SetAsyncExc(ctypes.c_ulong(thread.ident), ctypes.py_object(SystemExit))
    elif sabotage == "monotonic clock":
        real = CLOCKS["monotonic"]
        time.monotonic_ns = lambda: real() + round(value * 1e9)
    elif sabotage == "wall clock":
        wall = CLOCKS["wall"]
        time.time = lambda: wall() / 1e9 + value
    elif sabotage == "slow disk":
        os.fsync = os.fdatasync = lambda number: (time.sleep(value), CLOCKS["fsync"](number))[1]  # type: ignore[func-returns-value]
    elif sabotage == "slow write":
        os.pwrite = lambda *given: (time.sleep(value), CLOCKS["pwrite"](*given))[1]
    elif sabotage == "hang":
        time.sleep(value)


CLOCKS = {"monotonic": time.monotonic_ns, "wall": time.time_ns, "fsync": os.fsync, "pwrite": os.pwrite}


class LoopTransport:
    """Datagrams to and from the rig's robot."""

    OPTIONS: ClassVar[dict[str, str]] = {"folder": "where the two sockets are"}

    def __init__(self, options: dict[str, Any], states: tuple[str, ...], inputs: tuple[str, ...]) -> None:
        self._folder, self._nx, self._nu = Path(options["folder"]), len(states), len(inputs)
        self._socket: socket.socket | None = None
        self._up = False
        self._heard_ns = 0
        self._counters = dict.fromkeys(("received", "sent", "dropped_in", "dropped_out", "malformed", "lost"), 0)

    def open(self) -> None:
        path = self._folder / DAEMON
        path.unlink(missing_ok=True)
        self._socket = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
        self._socket.setblocking(False)
        self._socket.bind(str(path))

    def fileno(self) -> int:
        assert self._socket is not None
        return self._socket.fileno()

    def receive(self) -> list[Frame]:
        assert self._socket is not None
        frames = []
        with contextlib.suppress(BlockingIOError):
            while len(frames) < 16:
                data = self._socket.recv(65536)
                frames.append(Frame(time.monotonic_ns(), "observation", data))
        self._counters["received"] += len(frames)
        return frames

    def decode(self, frame: Frame) -> list[Observation | Command | LinkChanged | OverrideChanged]:
        found: list[Observation | Command | LinkChanged | OverrideChanged] = []
        if not self._up:
            found.append(LinkChanged(frame.arrival_ns, up=True, detail="heard"))
        self._up, self._heard_ns = True, frame.arrival_ns
        try:
            plain = json.loads(frame.data)
            if "raise" in plain:
                raise RuntimeError(plain["raise"])
            if "sabotage" in plain:
                sabotage(**plain)
                return found
            if "command" in plain:
                return [*found, Command(self._counters["received"], frame.arrival_ns, "external", tuple(plain["command"]), 0, 10**9)]
            if plain.get("anew"):
                found += [LinkChanged(frame.arrival_ns, up=up, detail="the robot started anew") for up in (False, True)]
            if plain.get("estop"):
                return [*found, OverrideChanged(frame.arrival_ns, "emergency_stop", "button")]
            x = tuple(float(v) for v in plain["x"])
            fault = "" if len(x) == self._nx and all(map(math.isfinite, x)) else "not finite"
            found.append(Observation(plain["seq"], plain["stamp_ns"], () if fault else x, fault))
        except (ValueError, KeyError, TypeError):
            self._counters["malformed"] += 1
        return found

    def poll(self, now_ns: int) -> list[LinkChanged]:
        if self._up and now_ns - self._heard_ns > LINK_LOST_NS:
            self._up = False
            return [LinkChanged(now_ns, up=False, detail="silent for 1 s")]
        return []

    def encode(self, command: Command) -> Frame:
        if len(command.u) != self._nu or not all(map(math.isfinite, command.u)):
            raise ValueError(f"u is {command.u}")
        plain = {"seq": command.seq, "u": command.u, "obs_seq": command.obs_seq, "ttl_ns": command.ttl_ns, "source": command.source}
        return Frame(time.monotonic_ns(), "command", json.dumps(plain).encode(), inbound=False)

    def send(self, frame: Frame) -> None:
        assert self._socket is not None
        try:
            self._socket.sendto(frame.data, str(self._folder / ROBOT))
            self._counters["sent"] += 1
        except OSError:
            self._counters["dropped_out"] += 1

    def inform(self, record: GateChanged | Decided) -> None:
        """Notes what the gate says, for tests that follow it."""
        if isinstance(record, GateChanged):
            with (self._folder / "said.jsonl").open("a") as said:
                said.write(json.dumps({"open": record.open, "reason": record.reason}) + "\n")

    def counters(self) -> dict[str, int]:
        return dict(self._counters)

    def close(self) -> None:
        if self._socket is not None:
            self._socket.close()
            self._socket = None


@hookimpl
def s2r_transports() -> list[Offer]:
    """The transport of this rig."""
    return [Offer("loop", f"{__name__}:LoopTransport")]


def saturated(v: float, w: float, speed: float = 0.2, track: float = 0.105) -> tuple[float, float]:
    """Each wheel is clipped on its own."""
    left, right = (min(max(v + side * w * track / 2, -speed), speed) for side in (-1.0, 1.0))
    return (left + right) / 2, (right - left) / track


SWAY_S = 200.0


class Robot:
    """A unicycle with arcs, one period of latency or more, wheels that saturate, a gain on w, and a little noise."""

    def __init__(self, folder: Path, args: argparse.Namespace) -> None:
        self.folder, self.dt, self.gain, self.args = folder, args.dt, args.gain, args
        self.x, self.under_way = [0.0, 0.0, 0.0], deque([(0.0, 0.0)] * args.latency)
        self.seq, self.stamp_ns = args.since, round(args.since * args.dt * 1e9)
        self.random = random.Random(args.seed)
        self.measured = (-1, b"")
        self.socket = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
        path = folder / ROBOT
        path.unlink(missing_ok=True)
        self.socket.bind(str(path))
        self.applied = (folder / "applied.jsonl").open("a", buffering=1)

    def publish(self) -> None:
        if self.seq != self.measured[0]:
            x = [v + self.random.gauss(0.0, 1e-4) for v in self.x]
            x[2] = math.remainder(x[2], 2.0 * math.pi)
            plain = {"seq": self.seq, "stamp_ns": self.stamp_ns, "x": x, "anew": self.seq == self.args.since > 0}
            self.measured = (self.seq, json.dumps(plain).encode())
        with contextlib.suppress(OSError):
            self.socket.sendto(self.measured[1], str(self.folder / DAEMON))

    def step(self, u: tuple[float, ...]) -> None:
        self.under_way.append(saturated(u[0], u[1] * self.gain))
        v, w = self.under_way.popleft()
        x, y, theta = self.x
        middle = theta + 0.5 * w * self.dt
        v *= 1.0 + self.args.sway * (self.stamp_ns * 1e-9 % SWAY_S > 0.5 * SWAY_S)
        chord = v * self.dt * (math.sin(0.5 * w * self.dt) / (0.5 * w * self.dt) if w else 1.0)
        self.x = [x + chord * math.cos(middle), y + chord * math.sin(middle), theta + w * self.dt]
        self.seq += 1
        self.stamp_ns += round(self.dt * 1e9)

    def commands(self, timeout_s: float) -> list[dict[str, Any]]:
        found = []
        while select.select([self.socket], [], [], timeout_s)[0]:
            found.append(json.loads(self.socket.recv(65536)))
            self.applied.write(json.dumps(found[-1] | {"at": self.seq}) + "\n")
            timeout_s = 0.0
        return found

    def lockstep(self) -> None:
        while True:
            self.publish()
            answers = [c for c in self.commands(0.1) if c["obs_seq"] == self.seq]
            if answers:
                self.step(answers[-1]["u"])

    def realtime(self) -> None:
        due, u, until = time.monotonic(), (0.0, 0.0), 0.0
        while True:
            self.publish()
            due += self.dt
            while (left := due - time.monotonic()) > 0:
                for command in self.commands(left):
                    u, until = tuple(command["u"]), time.monotonic() + command["ttl_ns"] * 1e-9
            self.step(u if time.monotonic() < until else (0.0, 0.0))


def main() -> int:
    """One of the two processes."""
    parser = argparse.ArgumentParser()
    which = parser.add_subparsers(dest="which", required=True)
    robot = which.add_parser("robot")
    robot.add_argument("folder", type=Path)
    robot.add_argument("--realtime", action="store_true")
    robot.add_argument("--dt", type=float, default=0.033)
    robot.add_argument("--gain", type=float, default=1.0)
    robot.add_argument("--latency", type=int, default=1, help="periods after which a command acts")
    robot.add_argument("--seed", type=int, default=1)
    robot.add_argument("--since", type=int, default=0, help="it was restarted: its numbers and stamps go on from this period")
    robot.add_argument("--sway", type=float, default=0.0, help="its speed is wrong by this share for half of the time")
    for name in ("daemon", "campaign"):
        daemon = which.add_parser(name)
        daemon.add_argument("profile", type=Path)
        daemon.add_argument("--state", type=Path)
        daemon.add_argument("--seed", type=int)
        daemon.add_argument("--break-at", type=int, default=0, help="the core raises at the observation of this number")
        if name == "daemon":
            daemon.add_argument("--log", type=Path)
            daemon.add_argument("--held", type=Path, help="where to note the longest processor times that held the loop, s")
        else:
            daemon.add_argument("out", type=Path)
    which.add_parser("s2r").add_argument("verb", nargs=argparse.REMAINDER)
    args = parser.parse_args()
    if args.which == "s2r":
        from s2r_runtime.cli.main import main as s2r
        from s2r_runtime.plugins import registry

        registry().add("rig", "tests", "0", sys.modules[__name__])
        return s2r(args.verb)
    if args.which == "robot":
        signal.signal(signal.SIGTERM, lambda *_: os._exit(0))
        robot_process = Robot(args.folder, args)
        robot_process.realtime() if args.realtime else robot_process.lockstep()
    return run(args)


def note_what_holds_the_loop(path: Path) -> None:
    """Processor time of the longest turn of the loop, s: for a client, for what came from the robot's side, and for what time brings."""
    from s2r_runtime.daemon.control import Connection
    from s2r_runtime.daemon.loop import Daemon

    longest = {"client": 0.0, "robot": 0.0, "tick": 0.0}

    def timed(what: str, function: Callable[..., None]) -> Callable[..., None]:
        def call(*arguments: Any) -> None:
            begun = time.thread_time()
            function(*arguments)
            if (took := time.thread_time() - begun) > longest[what]:
                longest[what] = took
                path.write_text(json.dumps(longest))

        return call

    Connection.ready = timed("client", Connection.ready)  # type: ignore[method-assign]
    Daemon._robot_ready = timed("robot", Daemon._robot_ready)  # type: ignore[method-assign]
    Daemon._tick = timed("tick", Daemon._tick)  # type: ignore[method-assign]


def run(args: argparse.Namespace) -> int:
    """The daemon, or one campaign."""
    from s2r_runtime.core import reducer as core
    from s2r_runtime.daemon.campaign_run import run_campaign
    from s2r_runtime.daemon.loop import Daemon
    from s2r_runtime.errors import S2RError
    from s2r_runtime.messages import Event, Observed
    from s2r_runtime.plugins import registry
    from s2r_runtime.profile import load_profile

    registry().add("rig", "tests", "0", sys.modules[__name__])
    handle = core.handle

    def breaking(state: core.State, event: Event) -> Any:
        if isinstance(event, Observed) and event.observation.seq == args.break_at:
            raise ZeroDivisionError("a defect")
        return handle(state, event)

    if getattr(args, "held", None):
        note_what_holds_the_loop(args.held)
    if args.break_at:
        core.handle = breaking
    try:
        profile = load_profile(args.profile)
        if args.which == "campaign":
            result = run_campaign(profile, args.profile, args.out, state_dir=args.state, seed=args.seed)
            print(json.dumps(result))
            return int(result["exit_code"])
        return Daemon(profile, profile_path=args.profile, state_dir=args.state, log_dir=args.log, seed=args.seed).run()
    except S2RError as error:
        print(f"s2r: {error}", file=sys.stderr)
        return error.exit_code


if __name__ == "__main__":
    raise SystemExit(main())
