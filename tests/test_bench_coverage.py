"""The coverage benchmark runs, and tells promises that hold from a planted fault. (A thousand repetitions: run the tool.)"""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import pytest

TOOL = Path(__file__).parent.parent / "tools" / "bench_coverage.py"


@pytest.mark.slow
def test_promises_hold_and_held_steps_used_as_samples_are_caught() -> None:
    command = [sys.executable, str(TOOL), "--repetitions", "50", "--json", "--seed", "3"]
    found = subprocess.run(command, capture_output=True, text=True, check=False)  # exit 1: too few to catch the weaker fault
    rows = {row["what"]: row for row in json.loads(found.stdout)["rows"]}
    assert rows["fault: all steps of each hold"]["ok"]
    promises = [row for row in rows.values() if not row["planted"]]
    assert len(promises) >= 7
    assert all(row["ok"] for row in promises)
