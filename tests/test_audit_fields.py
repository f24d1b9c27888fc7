"""One field of one record is changed, and the log signed with the true key: the audit sees it, or the docs name the field."""

from __future__ import annotations

import random
import re
import sys
from pathlib import Path

import msgspec
import pytest
from audit_bench import PUBLIC

from s2r_runtime.audit.log import audit
from s2r_runtime.messages import Started

sys.path.insert(0, str(Path(__file__).parent.parent / "tools"))

import bench_fields

CHANGES = 60


@pytest.fixture(scope="module")
def bench(tmp_path_factory: pytest.TempPathFactory) -> bench_fields.audit_bench.Bench:
    return bench_fields.run(tmp_path_factory.mktemp("fields") / "run", traced=False)


@pytest.mark.slow
def test_a_changed_field_is_seen_or_named_in_the_docs(bench: bench_fields.audit_bench.Bench, tmp_path: Path) -> None:
    assert audit([bench.write(tmp_path / "sound.mcap")], PUBLIC).ok
    rng, fields = random.Random(5), bench_fields.places(bench.items)
    for name in rng.sample(sorted(fields), CHANGES):
        number, at = rng.choice(fields[name])
        made = bench_fields.changed(bench.items[number], at, rng)
        if made is not None and not bench_fields.reason_of(name):
            assert bench_fields.seen(bench, number, made, tmp_path / "changed.mcap"), (name, bench.items[number], made)


@pytest.mark.slow
def test_a_command_that_left_elsewhere_or_not_at_all_is_seen(bench: bench_fields.audit_bench.Bench, tmp_path: Path) -> None:
    number = max(n for n, item in enumerate(bench.items) if getattr(item, "inbound", True) is False) - 40
    number = max(n for n, item in enumerate(bench.items[:number]) if getattr(item, "inbound", True) is False)
    frame = bench.items[number]
    for other in (bench_fields.msgspec.structs.replace(frame, channel="elsewhere"), None):
        bench.items[number : number + 1] = [] if other is None else [other]
        path = tmp_path / f"{other is None}.mcap"
        result = audit([bench.write(path)], PUBLIC)
        bench.items[number : number + (other is not None)] = [frame]
        assert not result.ok
        assert result.first_difference is not None
        assert "leave" in result.first_difference.what or "left" in result.first_difference.what


@pytest.mark.slow
def test_a_run_that_draws_its_seeds_is_no_simulation(bench: bench_fields.audit_bench.Bench, tmp_path: Path) -> None:
    number, started = next((n, item) for n, item in enumerate(bench.items) if isinstance(item, Started))
    bench.items[number] = msgspec.structs.replace(started, settings=msgspec.structs.replace(started.settings, simulated=True))
    result = audit([bench.write(tmp_path / "simulated.mcap")], PUBLIC)
    bench.items[number] = started
    assert result.first_difference is not None
    assert "a simulation fixes its seeds" in result.first_difference.what


def test_the_docs_name_what_nothing_recomputes() -> None:
    page = (Path(__file__).parent.parent / "docs" / "auditor.md").read_text(encoding="utf-8")
    rows = dict(re.findall(r"^\| `([^`]+)` \| (.+) \|$", page, re.MULTILINE))
    assert {name: rows.get(name) for name in bench_fields.NOT_RECOMPUTED} == bench_fields.NOT_RECOMPUTED
