"""What nobody should send to a daemon, or hand to a reader: refused in one line, by a process that lives on.

More of it: python tools/fuzz_door.py
"""

from __future__ import annotations

import random
import sys
from pathlib import Path

import pytest

sys.path.insert(0, str(Path(__file__).parent.parent / "tools"))

import fuzz_door


def test_no_request_and_no_file_is_anything_but_read_or_refused() -> None:
    rng = random.Random(3)
    found = {"request": fuzz_door.at_the_door(rng, 1000), **fuzz_door.of_files(rng, 60)}
    assert [line for one in found.values() for line in one.wrong] == []
    assert min(one.refused for one in found.values()) > 0


@pytest.mark.slow
def test_a_running_daemon_answers_all_of_it_and_its_controller_drives_on() -> None:
    found = fuzz_door.live(random.Random(4), 150)
    assert found.wrong == []
