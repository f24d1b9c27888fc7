"""A stand-in as a process of its own: two clocks, one link, and a door (stdin) for what is to happen to it. Whatever its body is.

    lockstep   observe, publish, wait for the command that answers, move for one period; repeat
    realtime   observe, publish, wait for a period of the host's clock, move for one period under the newest command; repeat

A command holds until its time to live is over by the robot's clock, then (0, 0) does. A body that is in trouble (it fell) says so in an
emergency stop, once, and in every observation from there on: those hold no state, which no runtime takes for a measurement.
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
import sys
import time
from collections.abc import Callable
from types import FrameType
from typing import Protocol

from s2r_runtime.child import die_with_parent
from s2r_runtime.errors import ConfigError, S2RError
from s2r_standins.faults import Pose, Twist
from s2r_standins.link import CommandPayload, Link

INPUTS = ("v", "w")
CONNECT = "tcp/127.0.0.1:7461"
KEEP_ALIVE_S = 0.1
DOOR = """
stdin      effect EFFECT [@TIME | @+SECONDS]   begin an effect: at once, at a time, or so long after now (robot's clock)
           clear [@TIME | @+SECONDS]           end all effects
           emergency_stop                      press the robot's red button
           quit
           The end of stdin changes nothing. stdout has one JSON line for each thing done, with the robot's time.
"""
CLOCKS = """
lockstep   the robot's clock is the clock: it publishes observation k with stamp k*period, waits for the command that answers
           it (repeating the observation every 0.1 s), moves for one period, and publishes k+1. Nobody answers: nothing moves.
realtime   a period lasts a period; the robot stops when its last command is older than the command's time to live.
"""


class Body(Protocol):
    """What moves."""

    @property
    def k(self) -> int:
        """Periods since it was switched on; its clock is k period_s."""

    @property
    def period_s(self) -> float:
        """A period of its link, s."""

    @property
    def now_s(self) -> float:
        """Its clock, s."""

    @property
    def trouble(self) -> str:
        """Why its state can't be told (it fell); empty while it can."""

    def observe(self) -> Pose:
        """The pose as measured now; called once a period."""

    def move(self, command: Twist) -> None:
        """One period under this command."""

    def check(self, text: str) -> None:
        """Raises ConfigError if this is no effect that it can have."""

    def switch_on(self, text: str) -> str:
        """Begins an effect now; returns which."""

    def clear(self) -> None:
        """Ends all effects."""


class Robot:
    """The body, its link, and what is to happen to it."""

    def __init__(self, body: Body, link: Link, options: argparse.Namespace) -> None:
        self._body, self._link, self._options = body, link, options
        self._loss = random.Random(f"{options.seed}/loss")
        self._command: Twist = (0.0, 0.0)
        self._valid_until = 0.0
        self._schedule: list[tuple[float, str]] = []
        self._input = b""
        self._told = False
        self.running = True
        for effect in options.effect:
            self._plan(f"effect {effect}")
        if sys.stdin is not None and not sys.stdin.closed:
            link.poller.register(0, select.POLLIN)

    # ------------------------------------------------------------------ the two clocks

    def lockstep(self) -> None:
        """Periods as fast as they are answered."""
        while self.running:
            self._happen()
            data = self._observation()
            lost, ignored = self._lost(self._options.lose_observations), self._lost(self._options.lose_commands)
            answer = None if lost else self._answer(data)
            self._move(None if ignored else answer)

    def _answer(self, data: bytes) -> CommandPayload | None:
        """Publishes until the command comes that answers this observation."""
        self._link.publish(data)
        while self.running:
            if not self._wait(KEEP_ALIVE_S):
                self._link.publish(data)
            command = self._link.latest()
            if command is not None and command.obs_seq == self._body.k:
                return command
        return None

    def realtime(self) -> None:
        """Periods of the host's clock. A process that was stopped for long takes its clock up where it stood."""
        period = self._body.period_s
        due = time.monotonic() + period
        while self.running:
            self._happen()
            data = self._observation()
            lost, ignored = self._lost(self._options.lose_observations), self._lost(self._options.lose_commands)
            if not lost:
                self._link.publish(data)
            newest = None
            while self.running and (left := due - time.monotonic()) > 0.0:
                self._wait(left)
                newest = self._link.latest() or newest
            if newest is not None and (self._body.k - newest.obs_seq) * period > newest.ttl_ns * 1e-9 + period:
                self._link.ignored, newest = self._link.ignored + 1, None
            self._move(None if ignored else newest)
            due = max(due + period, time.monotonic() - 10.0 * period)

    # ------------------------------------------------------------------ one period

    def _observation(self) -> bytes:
        stamp_ns = round(self._body.k * self._body.period_s * 1e9)
        x, y, theta = self._body.observe()
        trouble = self._body.trouble
        if trouble and not self._told:
            self._told = True
            self._link.stop_everything(trouble)
            self._say(trouble=trouble)
        return self._link.encode(self._body.k, stamp_ns, {} if trouble else {"x": x, "y": y, "theta": theta}, trouble)

    def _lost(self, probability: float) -> bool:
        """Drawn whether or not it matters, so that one seed gives one sequence."""
        return self._loss.random() < probability

    def _move(self, command: CommandPayload | None) -> None:
        """Obeys the newest command until its time to live is over, then stops."""
        now = self._body.now_s
        if command is not None:
            self._command = (command.input["v"], command.input["w"])
            self._valid_until = now + command.ttl_ns * 1e-9
        elif now >= self._valid_until:
            self._command = (0.0, 0.0)
        self._body.move(self._command)

    def _wait(self, seconds: float) -> bool:
        """Until a command is there (True) or the time is over; reads stdin by the way."""
        heard = False
        for descriptor, _ in self._link.poller.poll(max(1.0, 1000.0 * seconds)):
            if descriptor == 0:
                self._read()
            heard = heard or descriptor == self._link.fileno
        return heard

    # ------------------------------------------------------------------ what happens to it

    def _read(self) -> None:
        data = os.read(0, 65_536)
        if not data:
            self._link.poller.unregister(0)
        *lines, self._input = (self._input + data).split(b"\n")
        for line in lines:
            try:
                self._obey(line.decode("utf-8", "replace").strip())
            except S2RError as error:
                self._say(error=str(error))

    def _obey(self, line: str) -> None:
        if line == "quit":
            self.running = False
        elif line == "emergency_stop":
            self._link.stop_everything("the robot's button")
            self._say(done=line)
        elif line:
            self._plan(line)
            self._happen()

    def _plan(self, line: str) -> None:
        """Puts `effect ... [@T]` or `clear [@T]` on the schedule. Raises ConfigError."""
        action, _, when = line.partition("@")
        at = self._body.now_s
        if when:
            try:
                at = at + float(when[1:]) if when.startswith("+") else float(when)
            except ValueError:
                at = math.nan
            if not math.isfinite(at):
                raise ConfigError(f"{line!r}: the time after @ must be a number of seconds of the robot's clock, or +seconds")
        verb, _, effect = action.strip().partition(" ")
        if verb == "effect":
            self._body.check(effect)
        elif verb != "clear" or effect:
            raise ConfigError(f"{line!r}: must be effect EFFECT [@TIME], clear [@TIME], emergency_stop or quit")
        self._schedule.append((at, action.strip()))
        self._schedule.sort(key=lambda entry: entry[0])

    def _happen(self) -> None:
        """Does what is due at this period's beginning."""
        while self._schedule and self._schedule[0][0] <= self._body.now_s + 1e-9:
            _, action = self._schedule.pop(0)
            if action == "clear":
                self._body.clear()
            else:
                self._body.switch_on(action.partition(" ")[2])
            self._say(done=action)

    def _say(self, **facts: str) -> None:
        with contextlib.suppress(OSError):  # nobody reads
            print(json.dumps({"t": round(self._body.now_s, 6), **facts}), flush=True)


def add_link_options(p: argparse.ArgumentParser) -> None:
    """Options of every stand-in: where the runtime is, and which clock."""
    where = p.add_mutually_exclusive_group()
    where.add_argument("--connect", metavar="ENDPOINT", default="", help=f"the runtime's robot_listen (default {CONNECT})")
    where.add_argument("--listen", metavar="ENDPOINT", default="", help="wait here for the runtime's robot_connect instead")
    where.add_argument("--router", metavar="ENDPOINT", default="", help="be a client of this router instead")
    p.add_argument("--key-prefix", default="s2r/robot", help="keys are PREFIX/observation, ... (default %(default)s)")
    clock = p.add_mutually_exclusive_group()
    clock.add_argument("--lockstep", action="store_true", help="as fast as messages go (default)")
    clock.add_argument("--realtime", action="store_true", help="a period lasts a period")
    p.add_argument("--start", type=float, nargs=3, metavar=("X", "Y", "THETA"), default=(0.0, 0.0, 0.0), help="pose in m and rad")


def add_trouble_options(p: argparse.ArgumentParser) -> None:
    """Options of every stand-in: what is lost on the way, what is wrong with it, and when it ends."""
    p.add_argument("--lose-observations", type=float, metavar="P", default=0.0, help="probability that an observation is lost")
    p.add_argument("--lose-commands", type=float, metavar="P", default=0.0, help="probability that a command is lost")
    p.add_argument("--effect", action="append", default=[], metavar="EFFECT", help="undeclared, from the start or from @TIME; repeatable")
    p.add_argument("--parent", type=int, default=0, metavar="PID", help="end when this process, which must be the parent, does")


def run(name: str, options: argparse.Namespace, make: Callable[[argparse.Namespace], Body]) -> int:
    """Runs until `quit`, SIGTERM or SIGINT. Returns the exit code."""
    if options.parent:
        die_with_parent(options.parent)
    # a client of a router waits for it inside Zenoh, where Python's handlers do not run
    for number in (signal.SIGTERM, signal.SIGINT):
        signal.signal(number, signal.SIG_DFL)
    try:
        for option, lost in (("--lose-observations", options.lose_observations), ("--lose-commands", options.lose_commands)):
            if not 0.0 <= lost < 1.0:
                raise ConfigError(f"{option}: must be in [0, 1)")
        body = make(options)
        connect = options.connect or ("" if options.listen or options.router else CONNECT)
        # differs from start to start, so that a restart is noticed; no part of what the robot does
        boot = time.time_ns() % 2**53
        with Link(options.key_prefix, INPUTS, connect=connect, listen=options.listen, router=options.router, boot=boot) as link:
            robot = Robot(body, link, options)

            def end(_signal: int, _frame: FrameType | None) -> None:
                robot.running = False

            for number in (signal.SIGTERM, signal.SIGINT):
                signal.signal(number, end)
            (robot.realtime if options.realtime else robot.lockstep)()
    except S2RError as error:
        print(f"{name}: {error}", file=sys.stderr)
        return error.exit_code
    return 0


def start_command(module: str, seed: int, effects: list[str], connect: str) -> list[str]:
    """The argv that starts this stand-in; it ends with the process that starts it."""
    argv = [sys.executable, "-m", module, "--seed", str(seed), "--connect", connect, "--parent", str(os.getpid())]
    return argv + [word for effect in effects for word in ("--effect", effect)]


def with_endpoints(profile: str, robot_listen: str, controller_listen: str) -> str:
    """A profile's text with these endpoints in its transport."""
    for option, value in (("robot_listen", robot_listen), ("controller_listen", controller_listen)):
        lines = [f'{option} = "{value}"' if line.startswith(f"{option} ") else line for line in profile.splitlines()]
        profile = "\n".join(lines) + "\n"
    return profile
