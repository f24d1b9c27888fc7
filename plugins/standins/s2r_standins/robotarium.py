"""The Robotarium's robot as a process of its own: `python -m s2r_standins.robotarium --help`."""

from __future__ import annotations

import argparse
import math
import sys
from pathlib import Path

from s2r_runtime.errors import ConfigError
from s2r_runtime.hookspecs import Story
from s2r_standins.body import Body, DataSheet
from s2r_standins.process import CLOCKS, CONNECT, DOOR, add_link_options, add_trouble_options, run, start_command, with_endpoints

DATA = Path(__file__).parent / "data"
CONTROLLERS = {"good": "grid.py", "reckless": "grid_reckless.py"}
EPILOG = f"""{CLOCKS}
effects    what is wrong with this robot and not in its data sheet: any effect that is installed for the runtime's models,
           'input_gain:w gain=0.7', or slip_patch x= y= radius= gain=, or heading_ripple amplitude= waves=; they act after the
           wheels' limit, in the order given, and ' @TIME' at the end begins one at that second of the robot's clock.
           The runtime cannot see any of this.
{DOOR}
walls      the position is clamped to +-X, +-Y (default 2.0 1.4): the robot stops at the arena's wall, which no model knows.
"""


class BuiltIn:
    """What `s2r demo` needs to know (hook `s2r_robots`)."""

    profile = "robotarium"
    story = Story(("input_gain:w gain=0.7",), "input_gain:v gain=0.25", 15.0)

    def command(self, seed: int, effects: list[str], connect: str = CONNECT) -> list[str]:
        """The argv that starts the robot; it ends with the process that starts it."""
        return start_command("s2r_standins.robotarium", seed, effects, connect)

    def controller(self, name: str = "good") -> Path:
        """A controller that comes with the robot. Raises ConfigError for an unknown name."""
        if name not in CONTROLLERS:
            raise ConfigError(f"robot 'robotarium' comes with no controller {name!r}; there are: {', '.join(CONTROLLERS)}")
        return DATA / CONTROLLERS[name]

    def profile_text(self, robot_listen: str, controller_listen: str) -> str:
        """The robot's profile with these endpoints in its transport."""
        return with_endpoints((DATA / "robotarium.toml").read_text(encoding="utf-8"), robot_listen, controller_listen)


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
    add_link_options(p)
    p.add_argument("--seed", type=int, default=1, help="of noise and losses (default %(default)s)")
    p.add_argument("--period", type=float, default=sheet.dt, help="s (default %(default)s)")
    p.add_argument("--wheel-speed", type=float, default=sheet.wheel_speed, help="limit at each wheel, m/s (default %(default)s)")
    p.add_argument("--track", type=float, default=sheet.track, help="distance of the wheels, m (default %(default)s)")
    p.add_argument("--latency", type=int, default=sheet.latency, help="periods until a command acts (default %(default)s)")
    p.add_argument("--sigma-position", type=float, default=sheet.sigma_position, help="noise of x and y, m (default %(default)s)")
    p.add_argument("--sigma-heading", type=float, default=sheet.sigma_heading, help="noise of theta, rad (default %(default)s)")
    p.add_argument("--integration", choices=("exact", "euler"), default=sheet.integration, help="(default %(default)s)")
    p.add_argument("--walls", type=float, nargs=2, metavar=("X", "Y"), default=sheet.walls, help="half the arena, m (default 2.0 1.4)")
    add_trouble_options(p)
    return p


def _body(o: argparse.Namespace) -> Body:
    for name, ok, must in (
        ("--period", 0.0 < o.period < math.inf, "> 0 s"),
        ("--wheel-speed", 0.0 < o.wheel_speed < math.inf, "> 0 m/s"),
        ("--track", 0.0 < o.track < math.inf, "> 0 m"),
        ("--latency", 0 <= o.latency <= 100, "0 to 100 periods"),
        ("--sigma-position", 0.0 <= o.sigma_position < math.inf, ">= 0 m"),
        ("--sigma-heading", 0.0 <= o.sigma_heading < math.inf, ">= 0 rad"),
        ("--walls", min(o.walls) > 0.0, "> 0 m"),
    ):
        if not ok:
            raise ConfigError(f"{name}: must be {must}")
    walls = (o.walls[0], o.walls[1])
    sheet = DataSheet(o.period, o.wheel_speed, o.track, o.latency, o.sigma_position, o.sigma_heading, o.integration, walls)
    return Body(sheet, tuple(o.start), o.seed)


def main(argv: list[str] | None = None) -> int:
    """Runs until `quit`, SIGTERM or SIGINT. Returns the exit code."""
    return run("robotarium", parser().parse_args(argv), _body)


if __name__ == "__main__":
    sys.exit(main())
