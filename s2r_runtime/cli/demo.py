"""s2r demo: the whole loop on a built-in robot over real Zenoh on loopback.

Three processes, as on a robot: the stand-in, the daemon (`s2r run`), and this one, which says to the daemon what an
engineer would say on the command line. The tracer is told nothing of the effect that was switched on in the robot.
"""

from __future__ import annotations

import argparse
from pathlib import Path

from s2r_runtime.cli.choices import count


def add(verbs: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """Adds the verb."""
    verb = verbs.add_parser("demo")
    verb.add_argument("--robot", default="robotarium", metavar="NAME", help="which built-in robot (default robotarium)")
    verb.add_argument("--out", type=Path, metavar="DIR", help="where the log, the report and the rest go (default s2r-demo/run-NNN)")
    verb.add_argument("--seed", type=count, default=1, help="one seed gives one story (default 1)")
    verb.add_argument(
        "--effect", action="append", metavar="SPEC", help="undeclared effect in the robot from the start; may be repeated; 'none' for none"
    )
    verb.add_argument("--change", metavar="SPEC", help="undeclared effect that is switched on while the robot drives; 'none' for none")
    verb.set_defaults(run=run)


def run(args: argparse.Namespace) -> int:
    """Exit 0 if the story ended as evidence demands (also where it ends with a refusal) and its log passes the audit."""
    from s2r_runtime.cli.demonstration import Demonstration

    return Demonstration(args.robot, args.out, args.seed, args.effect, args.change).run()
