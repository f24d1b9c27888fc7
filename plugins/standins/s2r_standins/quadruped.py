"""A quadruped as a process of its own: `python -m s2r_standins.quadruped --help`. Its physics are in `quadruped_body`."""

from __future__ import annotations

import argparse
import importlib.util
import math
import sys
from pathlib import Path
from typing import TYPE_CHECKING

from s2r_runtime.errors import ConfigError
from s2r_runtime.hookspecs import Story
from s2r_standins.process import CLOCKS, CONNECT, DOOR, add_link_options, add_trouble_options, run, start_command, with_endpoints
from s2r_standins.quadruped_sheet import QuadrupedSheet

if TYPE_CHECKING:
    from s2r_standins.quadruped_body import Quadruped

DATA = Path(__file__).parent / "data"
CONTROLLERS = {"good": "quadruped_grid.py", "reckless": "quadruped_grid_reckless.py"}
EPILOG = f"""{CLOCKS}
           A period is 0.1 s (--period), in which the walking controller makes 100 steps.

falls      a robot that fell presses its own red button, once, stays down, and its observations hold no state from there on.

effects    what is wrong with this robot, its load or its floor; ' @TIME' at the end begins one at that second of the robot's clock.
           The runtime cannot see any of this.
             payload mass= [x= y=]          kg on the trunk, m before and to the left of its middle
             floor friction=                of the feet on the floor; 0.7 without it
             slope angle= [direction=]      rad; where it rises to, rad from the x axis (0 without it)
             weak_leg leg= strength=        front_left, front_right, rear_left, rear_right; factor on its motors' stiffness and limit
             latency delay=                 s until a command acts
             shoves force= rate=            N for 0.1 s at the trunk from a random side; so many a second on average
{DOOR}"""


DEMO_PERIOD_S = 1.0
"""As in quadruped-second.toml: a tenth of a second of walking says little of a robot that swings as far as it goes."""


class BuiltIn:
    """What `s2r demo` needs to know (hook `s2r_robots`)."""

    profile = "quadruped-second"
    story = Story(("weak_leg leg=rear_right strength=0.6",), "payload mass=4", 130.0, permit_s=14_400.0)

    def command(self, seed: int, effects: list[str], connect: str = CONNECT) -> list[str]:
        """The argv that starts the robot; it ends with the process that starts it. Raises ConfigError where its physics are missing."""
        require_physics()
        return [*start_command("s2r_standins.quadruped", seed, effects, connect), "--period", f"{DEMO_PERIOD_S:g}"]

    def controller(self, name: str = "good") -> Path:
        """A controller that comes with the robot. Raises ConfigError for an unknown name."""
        if name not in CONTROLLERS:
            raise ConfigError(f"robot 'quadruped' comes with no controller {name!r}; there are: {', '.join(CONTROLLERS)}")
        return DATA / CONTROLLERS[name]

    def profile_text(self, robot_listen: str, controller_listen: str) -> str:
        """The robot's profile with these endpoints in its transport."""
        return with_endpoints((DATA / f"{self.profile}.toml").read_text(encoding="utf-8"), robot_listen, controller_listen)


ROBOT = BuiltIn()


def require_physics() -> None:
    """Raises ConfigError, saying what to install, where there is no physics engine."""
    if importlib.util.find_spec("mujoco") is None:
        raise ConfigError("robot 'quadruped' needs the physics engine mujoco: pip install 's2r-standins[sim]'")


def parser() -> argparse.ArgumentParser:
    """The options; the defaults are the data sheet."""
    sheet = QuadrupedSheet()
    p = argparse.ArgumentParser(
        prog="python -m s2r_standins.quadruped",
        description="A walking quadruped in rigid-body physics, speaking Zenoh: forward speed and yaw rate, pose from noisy cameras.",
        epilog=EPILOG,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    add_link_options(p)
    p.add_argument("--seed", type=int, default=1, help="of gait phase, noise, shoves and losses (default %(default)s)")
    p.add_argument("--period", type=float, default=sheet.dt, help="of its link, s, whole ms (default %(default)s)")
    p.add_argument("--sigma-position", type=float, default=sheet.sigma_position, help="noise of x and y, m (default %(default)s)")
    p.add_argument("--sigma-heading", type=float, default=sheet.sigma_heading, help="noise of theta, rad (default %(default)s)")
    add_trouble_options(p)
    return p


def _body(o: argparse.Namespace) -> Quadruped:
    for name, ok, must in (
        ("--start", all(map(math.isfinite, o.start)), "finite"),
        ("--period", 0.001 <= o.period <= 60.0 and abs(1e3 * o.period - round(1e3 * o.period)) < 1e-6, "whole milliseconds, up to 60 s"),
        ("--sigma-position", 0.0 <= o.sigma_position < math.inf, ">= 0 m"),
        ("--sigma-heading", 0.0 <= o.sigma_heading < math.inf, ">= 0 rad"),
    ):
        if not ok:
            raise ConfigError(f"{name}: must be {must}")
    require_physics()
    from s2r_standins.quadruped_body import Quadruped

    sheet = QuadrupedSheet(dt=o.period, sigma_position=o.sigma_position, sigma_heading=o.sigma_heading)
    return Quadruped(sheet, tuple(o.start), o.seed)


def main(argv: list[str] | None = None) -> int:
    """Runs until `quit`, SIGTERM or SIGINT. Returns the exit code."""
    return run("quadruped", parser().parse_args(argv), _body)


if __name__ == "__main__":
    sys.exit(main())
