"""A stand-in ROS 2 robot over Zenoh as a process of its own: `python -m s2r_ros2.standin --help`. Its body is `s2r_standins.body`'s."""

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
from types import FrameType
from typing import Any

try:
    from s2r_standins.body import Body, DataSheet
except ImportError:
    sys.exit("standin: its body is in the package s2r_standins, which is not installed")

from s2r_ros2.keys import Layout
from s2r_ros2.options import COMMANDS, POSES
from s2r_ros2.payloads import (
    Located,
    encode_bool,
    encode_odometry,
    encode_pose_stamped,
    encode_transforms,
)
from s2r_ros2.standin_link import Link, node
from s2r_runtime.child import die_with_parent
from s2r_runtime.errors import ConfigError, S2RError

LISTEN = "tcp/127.0.0.1:7447"
"""Where a bridge and a rmw_zenohd listen."""
SHEET = DataSheet(dt=0.05, wheel_speed=0.22, track=0.16, latency=1, sigma_position=0.0003, sigma_heading=0.001, walls=(10.0, 10.0))
COMMAND_TIMEOUT_S = 0.5
BUTTON_EVERY = 5
COLLECT_S = 0.002
EPOCH_NS = 1_700_000_000_000_000_000
"""Its clock when it is switched on, ns since 1970: any time will do."""
EPILOG = """
stdin      effect EFFECT          begin an undeclared effect: any that is installed for the runtime's models, 'input_gain:v gain=0.8'
           clear                  end all effects
           emergency_stop         press the red button (topic emergency_stop, std_msgs/msg/Bool); `release` lets it go
           silent SECONDS         send nothing for so long
           reboot [SECONDS]       be silent for so long (default 1) and start anew: another publisher, counting from 1
           clock SECONDS          set its clock by so much, as NTP might
           quit                   also SIGTERM
           The end of stdin changes nothing. stdout has one JSON line for each thing done, and one with the counts at the end.
"""


class Standin:
    """Body and link, and what is to happen to them."""

    def __init__(self, body: Body, link: Link, options: argparse.Namespace) -> None:
        self._body, self._link, self._options = body, link, options
        self._loss = random.Random(f"{options.seed}/loss")
        self._command, self._commanded_at = (0.0, 0.0), -math.inf
        self._offset_ns = 0
        self._pressed = False
        self._silent_until = 0.0
        self._twist = (0.0, 0.0)
        self._input = b""
        self._waits: list[Any] = [link.fileno(), *([0] if sys.stdin is not None and not sys.stdin.closed else [])]
        self.running = True
        self.tally = dict.fromkeys(("periods", "sent", "withheld", "commands", "stopped_periods"), 0)

    def run(self) -> None:
        """Periods of the host's clock, or as fast as they are answered."""
        dt = self._body.sheet.dt
        due = time.monotonic() + dt
        while self.running:
            self._publish()
            if self._options.eager:
                self._await()
            else:
                self._listen(due)
            fresh = time.monotonic() - self._commanded_at <= COMMAND_TIMEOUT_S and not self._pressed
            self.tally["stopped_periods"] += not fresh
            self.tally["periods"] += 1
            before = self._body.pose
            self._body.move(self._command if fresh else (0.0, 0.0))
            self._twist = _twist(before, self._body.pose, dt)
            due = max(due + dt, time.monotonic() - 10.0 * dt)

    # ------------------------------------------------------------------ out

    def _publish(self) -> None:
        x, y, theta = self._body.observe()
        lost = self._loss.random() < self._options.lose
        if time.monotonic() < self._silent_until or lost:
            self.tally["withheld"] += 1
            if lost:
                self._link.lose("pose")
            return
        stamp_ns = EPOCH_NS + self._offset_ns + round(self._body.k * self._body.sheet.dt * 1e9)
        if self._body.k % BUTTON_EVERY == 0:
            self._link.put("button", encode_bool(self._pressed), stamp_ns)
        o, half = self._options, 0.5 * theta
        twist = (self._twist[0], 0.0, 0.0, 0.0, 0.0, self._twist[1])
        at = Located(stamp_ns, o.frame, o.child_frame, (x, y, 0.0), (0.0, 0.0, math.sin(half), math.cos(half)), twist)
        if o.pose == "odometry":
            data = encode_odometry(at)
        else:
            data = encode_pose_stamped(at) if o.pose == "pose_stamped" else encode_transforms([at])
        self._link.put("pose", data, stamp_ns)
        self.tally["sent"] += 1

    # ------------------------------------------------------------------ in

    def _listen(self, due: float) -> None:
        """Commands and stdin until then."""
        while self.running and (left := due - time.monotonic()) > 0.0:
            ready, _, _ = select.select(self._waits, [], [], left)
            if 0 in ready:
                self._read()
            command = self._link.latest()
            if command is not None:
                self._command, self._commanded_at = command, time.monotonic()
                self.tally["commands"] += 1

    def _await(self) -> None:
        """Until a command came, and a little longer, so that the newest counts; or for so long that there is nobody."""
        before, end = self.tally["commands"], time.monotonic() + 0.2
        while self.running and self.tally["commands"] == before and time.monotonic() < end:
            self._listen(min(end, time.monotonic() + COLLECT_S))
        self._listen(time.monotonic() + COLLECT_S)

    # ------------------------------------------------------------------ what happens to it

    def _read(self) -> None:
        data = os.read(0, 65_536)
        if not data:
            self._waits.remove(0)
        *lines, self._input = (self._input + data).split(b"\n")
        for line in lines:
            try:
                self.obey(line.decode("utf-8", "replace").strip())
            except S2RError as error:
                self.say(error=str(error))

    def obey(self, line: str) -> None:
        """One line of stdin. Raises ConfigError."""
        verb, _, rest = line.partition(" ")
        match verb:
            case "":
                return
            case "quit":
                self.running = False
            case "effect":
                self._body.switch_on(rest)
            case "clear":
                self._body.clear()
            case "emergency_stop" | "release":
                self._pressed = verb == "emergency_stop"
            case "silent":
                self._silent_until = time.monotonic() + _seconds(rest, line, least=0.0)
            case "reboot":
                self._silent_until = time.monotonic() + _seconds(rest or "1", line, least=0.0)
                self._commanded_at = -math.inf
                self._link.begin()
            case "clock":
                self._offset_ns += round(_seconds(rest, line, least=-1e6) * 1e9)
            case _:
                raise ConfigError(
                    f"{line!r}: must be effect, clear, emergency_stop, release, silent SECONDS, reboot [SECONDS], clock SECONDS or quit"
                )
        self.say(done=line)

    def say(self, **facts: Any) -> None:
        """One line of JSON."""
        with contextlib.suppress(OSError):  # nobody reads
            print(json.dumps({"t": round(self._body.now_s, 6), **facts}), flush=True)


def _twist(before: tuple[float, ...], after: tuple[float, ...], dt: float) -> tuple[float, float]:
    """(v, w) that lead from one pose to the next."""
    turn = math.remainder(after[2] - before[2], 2.0 * math.pi)
    middle = before[2] + 0.5 * turn
    return ((after[0] - before[0]) * math.cos(middle) + (after[1] - before[1]) * math.sin(middle)) / dt, turn / dt


def _seconds(text: str, line: str, *, least: float) -> float:
    try:
        seconds = float(text)
    except ValueError:
        seconds = math.nan
    if not least <= seconds <= 1e6:
        raise ConfigError(f"{line!r}: must be a number of seconds")
    return seconds


def parser() -> argparse.ArgumentParser:
    """The options; the defaults are the data sheet that the profile `turtlebot-ros2-zenoh` declares."""
    p = argparse.ArgumentParser(
        prog="python -m s2r_ros2.standin",
        description="A robot of TurtleBot's size that speaks ROS 2 over Zenoh: Twist commands on two wheels, noisy poses. Real time.",
        epilog=EPILOG,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    p.add_argument("--layout", choices=("bridge", "rmw"), default="bridge", help="as zenoh-bridge-ros2dds or as rmw_zenoh (default bridge)")
    where = p.add_mutually_exclusive_group()
    where.add_argument("--listen", metavar="ENDPOINT", default=LISTEN, help="where its bridge or router listens (default %(default)s)")
    where.add_argument("--connect", metavar="ENDPOINT", default="", help="the runtime's robot_listen, or a router, instead")
    p.add_argument("--domain", type=int, default=0, help="rmw (default 0)")
    p.add_argument("--namespace", default="", help="as the transport's option")
    p.add_argument("--pose", choices=tuple(POSES), default="odometry", help="(default %(default)s)")
    p.add_argument("--pose-topic", default="", help="(default odom, pose or /tf)")
    p.add_argument("--frame", default="odom", help="(default %(default)s)")
    p.add_argument("--child-frame", default="base_footprint", help="(default %(default)s)")
    p.add_argument("--command", choices=tuple(COMMANDS), default="twist", help="(default %(default)s)")
    p.add_argument("--command-topic", default="cmd_vel", help="(default %(default)s)")
    p.add_argument("--seed", type=int, default=1, help="of noise and losses (default %(default)s)")
    p.add_argument("--start", type=float, nargs=3, metavar=("X", "Y", "THETA"), default=(0.0, 0.0, 0.0), help="pose in m and rad")
    p.add_argument("--period", type=float, default=SHEET.dt, help="s (default %(default)s)")
    p.add_argument("--latency", type=int, default=SHEET.latency, help="periods until a command acts (default %(default)s)")
    p.add_argument("--wheel-speed", type=float, default=SHEET.wheel_speed, help="limit at each wheel, m/s (default %(default)s)")
    p.add_argument("--effect", action="append", default=[], metavar="EFFECT", help="undeclared, from the start; repeatable")
    p.add_argument(
        "--eager", action="store_true", help="a period is over when a command came: time goes as fast as it is answered, for tests"
    )
    p.add_argument("--lose", type=float, default=0.0, metavar="P", help="probability that a pose is not sent")
    p.add_argument("--parent", type=int, default=0, metavar="PID", help="end when this process, which must be the parent, does")
    return p


def _checked(o: argparse.Namespace) -> DataSheet:
    for name, ok, must in (
        ("--period", 0.001 <= o.period <= 1.0, "0.001 to 1 s"),
        ("--latency", 0 <= o.latency <= 100, "0 to 100 periods"),
        ("--wheel-speed", 0.0 < o.wheel_speed < math.inf, "> 0 m/s"),
        ("--lose", 0.0 <= o.lose < 1.0, "in [0, 1)"),
    ):
        if not ok:
            raise ConfigError(f"{name}: must be {must}")
    return SHEET._replace(dt=o.period, latency=o.latency, wheel_speed=o.wheel_speed)


def main(argv: list[str] | None = None) -> int:
    """Runs until `quit`, SIGTERM or SIGINT. Returns the exit code."""
    o = parser().parse_args(argv)
    if o.parent:
        die_with_parent(o.parent)
    try:
        body = Body(_checked(o), tuple(o.start), o.seed)
        for effect in o.effect:
            body.switch_on(effect)
        with node(o) as session, contextlib.closing(Link(session, Layout(o.layout, o.domain, o.namespace.strip("/")), o)) as link:
            robot = Standin(body, link, o)

            def end(_signal: int, _frame: FrameType | None) -> None:
                robot.running = False

            for number in (signal.SIGTERM, signal.SIGINT):
                signal.signal(number, end)
            robot.run()
            robot.say(**robot.tally, ignored=link.ignored)
    except S2RError as error:
        print(f"standin: {error}", file=sys.stderr)
        return error.exit_code
    return 0


if __name__ == "__main__":
    sys.exit(main())
