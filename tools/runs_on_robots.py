"""Runs on the built-in robots (guarantee G10): 300 scenarios in lockstep, the limits after them, the audit and the report.

    tools/runs_on_robots.py [robotarium | quadruped] [--runs 300] [--seed 1] [--out FOLDER] [--minutes 30]

The demo's own story, without a hidden fault, up to a certified controller. It then drives until that number of runs is counted. Prints the
operator's line, the audit's verdict, and the report's path. Exit 1 if the log does not hold, or the upper limit is above 1.3 %.
"""

from __future__ import annotations

import argparse
import re
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

from s2r_runtime.cli.demonstration import Demonstration, _s2r

PATIENT = "observation_timeout = 30.0\nlease = 30.0\n"
"""Of the link: in lockstep the robot's clock stands still while a busy computer does something else, so silence is no loss of the link."""
HEADROOM = 4.0
"""300 runs are long against a campaign of some 160 samples: the gap grows, and a run in which it outgrows the certificate is unsafe."""
MOST = 0.013
"""Upper limit after 300 safe runs."""


class Runs(Demonstration):
    """The demo that drives for a number of runs."""

    def __init__(self, robot: str, out: Path, seed: int, runs: int, minutes: float) -> None:
        super().__init__(robot, out, seed, [], "none")
        self._runs, self._until = runs, time.monotonic() + 60.0 * minutes
        self.found: dict[str, Any] = {}

    def _write_profile(self, ports: list[int]) -> Path:
        path = super()._write_profile(ports)
        text = re.sub(r"(?m)^episodes = \d+$", "episodes = 0", path.read_text(encoding="utf-8"))
        text = re.sub(r"(?m)^headroom = [0-9.]+$", f"headroom = {HEADROOM}", text)
        before, _, transport = text.partition("[transport]\n")
        own = re.sub(r"(?m)^(observation_timeout|lease) = .*\n?", "", transport)
        path.write_text(f"{before}[transport]\n{PATIENT}{own}", encoding="utf-8")
        return path

    def _watch_it(self, robot: subprocess.Popen[str]) -> bool:
        while robot.poll() is None and time.monotonic() < self._until:
            status = dict(self._call({"verb": "status"}).get("data") or {})
            self.found = (status.get("runs") or {}).get("all") or {}
            if self.found.get("n", 0) >= self._runs:
                return True
            if not status.get("controller") and not status.get("job"):
                return self._otherwise(f"driving ended after {self.found.get('n', 0)} runs: {status.get('reason')}")
            time.sleep(0.2)
        return self._otherwise(f"the time is over after {self.found.get('n', 0)} runs")

    def _afterwards(self, held: bool) -> int:
        """Without running the controller again, which the audit of a demo does: that takes as long as driving."""
        logs = sorted(map(str, (self._out / "logs").glob("*.mcap")))
        audited, lines = _s2r("audit", *logs, "--key", str(self._out / "state" / "key.pub"))
        print("\n".join(lines))
        reported, lines = _s2r("report", *logs, "-o", str(self._out / "report.html"))
        print("\n".join(lines) if reported else f"report {self._out / 'report.html'}")
        return 0 if held and not audited and not reported else 1


def main(arguments: list[str]) -> int:
    """One robot."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("robot", nargs="?", default="robotarium", choices=("robotarium", "quadruped"))
    parser.add_argument("--runs", type=int, default=300)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--minutes", type=float, default=30.0)
    parser.add_argument("--out", type=Path)
    args = parser.parse_args(arguments)
    out = args.out or Path(tempfile.mkdtemp(prefix="runs-")) / args.robot
    story = Runs(args.robot, out, args.seed, args.runs, args.minutes)
    code = story.run()
    print(story.found.get("statement", "no run was counted"))
    return code or int(story.found.get("upper", 1.0) > MOST)


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
