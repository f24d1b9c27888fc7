"""The Robotarium's robot as a process of its own: `python -m s2r_standins.robotarium --help`."""

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
from pathlib import Path
from types import FrameType

from s2r_runtime.child import die_with_parent
from s2r_runtime.errors import ConfigError, S2RError
from s2r_standins.body import Body, DataSheet
from s2r_standins.faults import Twist, parse_effect
from s2r_standins.link import CommandPayload, Link

INPUTS = ("v", "w")
CONNECT = "tcp/127.0.0.1:7461"
KEEP_ALIVE_S = 0.1
DATA = Path(__file__).parent / "data"
CONTROLLERS = {"good": "grid.py", "reckless": "grid_reckless.py"}
EPILOG = """
lockstep   the robot's clock is the clock: it publishes observation k with stamp k*period, waits for the command that answers
           it (repeating the observation every 0.1 s), moves for one period, and publishes k+1. Nobody answers: nothing moves.
realtime   a period lasts a period; the robot stops when its last command is older than the command's time to live.

effects    what is wrong with this robot and not in its data sheet: any effect that is installed for the runtime's models,
           'input_gain:w gain=0.7', or slip_patch x= y= radius= gain=, or heading_ripple amplitude= waves=; they act after the
           wheels' limit, in the order given, and ' @TIME' at the end begins one at that second of the robot's clock.
           The runtime cannot see any of this.

stdin      effect EFFECT [@TIME | @+SECONDS]   begin an effect: at once, at a time, or so long after now (robot's clock)
           clear [@TIME | @+SECONDS]           end all effects
           emergency_stop                      press the robot's red button
           quit
           The end of stdin changes nothing. stdout has one JSON line for each thing done, with the robot's time.

walls      the position is clamped to +-X, +-Y (default 2.0 1.4): the robot stops at the arena's wall, which no model knows.
"""


class Robot:
    """The body, its link, and what is to happen to it."""

    def __init__(self, body: Body, link: Link, options: argparse.Namespace) -> None:
        self._body, self._link, self._options = body, link, options
        self._loss = random.Random(f"{options.seed}/loss")
        self._command: Twist = (0.0, 0.0)
        self._valid_until = 0.0
        self._schedule: list[tuple[float, str]] = []
        self._input = b""
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
        period = self._body.sheet.dt
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
        x, y, theta = self._body.observe()
        stamp_ns = round(self._body.k * self._body.sheet.dt * 1e9)
        return self._link.encode(self._body.k, stamp_ns, {"x": x, "y": y, "theta": theta})

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
            parse_effect(effect)
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


class BuiltIn:
    """What `s2r demo` needs to know (hook `s2r_robots`)."""

    profile = "robotarium"

    def command(self, seed: int, effects: list[str], connect: str = CONNECT) -> list[str]:
        """The argv that starts the robot; it ends with the process that starts it."""
        argv = [sys.executable, "-m", "s2r_standins.robotarium", "--seed", str(seed), "--connect", connect, "--parent", str(os.getpid())]
        return argv + [word for effect in effects for word in ("--effect", effect)]

    def controller(self, name: str = "good") -> Path:
        """A controller that comes with the robot. Raises ConfigError for an unknown name."""
        if name not in CONTROLLERS:
            raise ConfigError(f"robot 'robotarium' comes with no controller {name!r}; there are: {', '.join(CONTROLLERS)}")
        return DATA / CONTROLLERS[name]

    def profile_text(self, robot_listen: str, controller_listen: str) -> str:
        """The robot's profile with these endpoints in its transport."""
        text = (DATA / "robotarium.toml").read_text(encoding="utf-8")
        for option, value in (("robot_listen", robot_listen), ("controller_listen", controller_listen)):
            lines = [f'{option} = "{value}"' if line.startswith(f"{option} ") else line for line in text.splitlines()]
            text = "\n".join(lines) + "\n"
        return text


ROBOT = BuiltIn()


def parser() -> argparse.ArgumentParser:
    """The options; the defaults are the data sheet that the profile `robotarium` declares."""
    sheet = DataSheet()
    p = argparse.ArgumentParser(
        prog="python -m s2r_standins.robotarium",
        description="The Robotarium's robot, speaking Zenoh: unicycle commands on two wheels, pose from noisy cameras.",
        epilog=EPILOG,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    where = p.add_mutually_exclusive_group()
    where.add_argument("--connect", metavar="ENDPOINT", default="", help=f"the runtime's robot_listen (default {CONNECT})")
    where.add_argument("--listen", metavar="ENDPOINT", default="", help="wait here for the runtime's robot_connect instead")
    where.add_argument("--router", metavar="ENDPOINT", default="", help="be a client of this router instead")
    p.add_argument("--key-prefix", default="s2r/robot", help="keys are PREFIX/observation, ... (default %(default)s)")
    clock = p.add_mutually_exclusive_group()
    clock.add_argument("--lockstep", action="store_true", help="as fast as messages go (default)")
    clock.add_argument("--realtime", action="store_true", help="a period lasts a period")
    p.add_argument("--seed", type=int, default=1, help="of noise and losses (default %(default)s)")
    p.add_argument("--start", type=float, nargs=3, metavar=("X", "Y", "THETA"), default=(0.0, 0.0, 0.0), help="pose in m and rad")
    p.add_argument("--period", type=float, default=sheet.dt, help="s (default %(default)s)")
    p.add_argument("--wheel-speed", type=float, default=sheet.wheel_speed, help="limit at each wheel, m/s (default %(default)s)")
    p.add_argument("--track", type=float, default=sheet.track, help="distance of the wheels, m (default %(default)s)")
    p.add_argument("--latency", type=int, default=sheet.latency, help="periods until a command acts (default %(default)s)")
    p.add_argument("--sigma-position", type=float, default=sheet.sigma_position, help="noise of x and y, m (default %(default)s)")
    p.add_argument("--sigma-heading", type=float, default=sheet.sigma_heading, help="noise of theta, rad (default %(default)s)")
    p.add_argument("--integration", choices=("exact", "euler"), default=sheet.integration, help="(default %(default)s)")
    p.add_argument("--walls", type=float, nargs=2, metavar=("X", "Y"), default=sheet.walls, help="half the arena, m (default 2.0 1.4)")
    p.add_argument("--lose-observations", type=float, metavar="P", default=0.0, help="probability that an observation is lost")
    p.add_argument("--lose-commands", type=float, metavar="P", default=0.0, help="probability that a command is lost")
    p.add_argument("--effect", action="append", default=[], metavar="EFFECT", help="undeclared, from the start or from @TIME; repeatable")
    p.add_argument("--parent", type=int, default=0, metavar="PID", help="end when this process, which must be the parent, does")
    return p


def _checked(o: argparse.Namespace) -> DataSheet:
    for name, ok, must in (
        ("--period", 0.0 < o.period < math.inf, "> 0 s"),
        ("--wheel-speed", 0.0 < o.wheel_speed < math.inf, "> 0 m/s"),
        ("--track", 0.0 < o.track < math.inf, "> 0 m"),
        ("--latency", 0 <= o.latency <= 100, "0 to 100 periods"),
        ("--sigma-position", 0.0 <= o.sigma_position < math.inf, ">= 0 m"),
        ("--sigma-heading", 0.0 <= o.sigma_heading < math.inf, ">= 0 rad"),
        ("--lose-observations", 0.0 <= o.lose_observations < 1.0, "in [0, 1)"),
        ("--lose-commands", 0.0 <= o.lose_commands < 1.0, "in [0, 1)"),
        ("--walls", min(o.walls) > 0.0, "> 0 m"),
    ):
        if not ok:
            raise ConfigError(f"{name}: must be {must}")
    walls = (o.walls[0], o.walls[1])
    return DataSheet(o.period, o.wheel_speed, o.track, o.latency, o.sigma_position, o.sigma_heading, o.integration, walls)


def main(argv: list[str] | None = None) -> int:
    """Runs until `quit`, SIGTERM or SIGINT. Returns the exit code."""
    options = parser().parse_args(argv)
    if options.parent:
        die_with_parent(options.parent)
    # a client of a router waits for it inside Zenoh, where Python's handlers do not run
    for number in (signal.SIGTERM, signal.SIGINT):
        signal.signal(number, signal.SIG_DFL)
    try:
        body = Body(_checked(options), tuple(options.start), options.seed)
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
        print(f"robotarium: {error}", file=sys.stderr)
        return error.exit_code
    return 0


if __name__ == "__main__":
    sys.exit(main())
