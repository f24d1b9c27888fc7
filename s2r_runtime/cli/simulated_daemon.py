"""`s2r run` for a built-in robot in simulation: `--seed` also fixes the seeds of verifications, so that one seed gives one story.

Only what simulates starts it (`s2r demo`); the log and each certificate say that the seeds were fixed, and no daemon loads such a one.
"""

from __future__ import annotations

import argparse
import sys

from s2r_runtime.cli import daemon_verbs, main
from s2r_runtime.evidence import seeds


def _run(args: argparse.Namespace) -> int:
    return daemon_verbs.run_daemon(args, simulated_seeds=seeds.simulated(args.seed or 0))


if __name__ == "__main__":
    sys.exit(main.main(["run", *sys.argv[1:]], _run))
