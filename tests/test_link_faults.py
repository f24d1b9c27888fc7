"""Faults of real links under a running daemon: each moves nothing that may not move, and a certified controller drives again.

All of them, over each link: python tools/bench_daemon_faults.py --link zenoh|mavlink|can --quick
"""

from __future__ import annotations

from pathlib import Path

import pytest
from link_faults import KINDS, LINK_FAULTS, LinkDrill, judged

SHARE = {
    "observation not finite": {"observation_invalid"},
    "observation out of order": set(),
    "link cut for 2 s": set(),
    "an outsider commands": set(),
}
"""What the gate must have said of each, at least; what else it may say depends on the link."""


@pytest.mark.parametrize("kind", ["mavlink", *(pytest.param(kind, marks=pytest.mark.slow) for kind in KINDS if kind != "mavlink")])
def test_faults_of_a_real_link_move_nothing_and_mend(tmp_path: Path, kind: str) -> None:
    pytest.importorskip(f"s2r_{kind}")
    drill = LinkDrill(tmp_path, kind)
    try:
        drill.begin()
        for name, least in SHARE.items():
            assert least <= set(drill.run(name).reasons), name
        drill.rig.stop()
        assert judged(drill)["commands"] > 20
    finally:
        drill.rig.close()


def test_every_fault_of_a_link_has_a_name_of_its_own() -> None:
    assert len(LINK_FAULTS) >= 28
