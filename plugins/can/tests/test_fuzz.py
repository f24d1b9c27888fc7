"""A seeded share of tools/fuzz_can.py: no crash, and nothing accepted that no good frame said. And it can fail."""

from __future__ import annotations

import importlib.util
import sys
from pathlib import Path

import pytest
from s2r_can import bits
from s2r_can.checksums import Guarded
from s2r_can.testing import CLASSIC, WIDE

TOOL = Path(__file__).parents[3] / "tools" / "fuzz_can.py"
SPEC = importlib.util.spec_from_file_location("fuzz_can", TOOL)
assert SPEC is not None
assert SPEC.loader is not None
fuzz_can = importlib.util.module_from_spec(SPEC)
sys.modules["fuzz_can"] = fuzz_can
SPEC.loader.exec_module(fuzz_can)


@pytest.mark.slow
@pytest.mark.parametrize("dbc", [CLASSIC, WIDE], ids=["classic", "wide"])
def test_nothing_is_accepted_that_no_good_frame_said(dbc: str) -> None:
    found = fuzz_can.fuzz(10_000, 7, dbc)
    assert found.lies == []
    assert found.observations > 1000
    assert found.faults > 1000


@pytest.mark.parametrize("what", ["checksum", "range"])
def test_decoder_that_does_not_look_would_be_found_out(what: str, monkeypatch: pytest.MonkeyPatch) -> None:
    if what == "checksum":
        monkeypatch.setattr(Guarded, "expected", lambda self, payload: payload[self.first])
    else:
        monkeypatch.setattr(bits, "NUMBER_MAX", float("inf"))
        monkeypatch.setattr("s2r_can.layout.NUMBER_MAX", float("inf"))
    assert fuzz_can.fuzz(3000, 7, WIDE).lies != []
