"""Records of the tracer's answers: appended as they are made, compared in pairs by a test that is checked by enumeration."""

import gzip
import itertools
import json
import math
import subprocess
import sys
from pathlib import Path

import bench_trace
import msgspec
import pytest
import trace_records
from trace_records import mcnemar, paired, read, verdict_of

from s2r_runtime.modelspec import EffectSpec, ModelSpec

TOOL = Path(__file__).parent.parent / "tools" / "trace_records.py"


def a_record(family="one", seed=0, **changes):
    answer = {"verdict": "traced", "outcome": "right", "judgement": "right", "effects": [], "depends_on": [], "again": None}
    return {"family": family, "seed": seed, **answer, "cpu_s": 1.0, "digest": "a", **changes}


def write(path, records):
    path.write_text("".join(json.dumps(r) + "\n" for r in records))
    return path


def compared(old, new, *options):
    command = [sys.executable, str(TOOL), "compare", str(old), str(new), *options]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    return done.returncode, done.stdout


@pytest.mark.parametrize(("gained", "lost"), [(g, d) for g in range(6) for d in range(6)])
def test_the_exact_p_is_that_of_all_sign_patterns(gained, lost):
    """Under the null each discordant pair goes either way with the same chance: all 2^n patterns are as likely."""
    n = gained + lost
    patterns = itertools.product((0, 1), repeat=n)
    at_least_as_uneven = sum(abs(2 * sum(p) - n) >= abs(gained - lost) for p in patterns)
    assert mcnemar(gained, lost) == pytest.approx(at_least_as_uneven / 2**n)


def test_the_exact_p_is_twice_the_binomial_tail_for_many_pairs():
    tail = sum(math.comb(60, k) for k in range(21)) / 2**60
    assert mcnemar(20, 40) == mcnemar(40, 20) == pytest.approx(2 * tail)
    assert mcnemar(0, 0) == 1.0


def test_pairs_are_counted_by_set_and_not_in_total():
    has = [(True, True), (True, False), (False, True), (False, True), (False, False)]
    pairs = [({"has": a}, {"has": b}) for a, b in has]
    assert paired(pairs, lambda r: r["has"]) == (5, 2, 3, 2, 1)


def of_outcomes(before, after, family="one"):
    return [
        (
            a_record(family, k, judgement=a, outcome="right" if a == "right" else "wrong"),
            a_record(family, k, judgement=b, outcome="right" if b == "right" else "wrong"),
        )
        for k, (a, b) in enumerate(zip(before, after, strict=True))
    ]


def worse(pairs):
    return {(name, family) for name, family, _, bad in verdict_of(pairs) if bad}


def test_losses_that_gains_balance_are_no_loss():
    assert worse(of_outcomes(["right"] * 3 + ["wrong"] * 3, ["wrong"] * 3 + ["right"] * 3)) == set()


def test_one_set_of_a_few_may_change_by_itself_and_two_may_not():
    assert worse(of_outcomes(["right"] * 10, ["wrong"] + ["right"] * 9)) == set()
    assert ("good", "one") in worse(of_outcomes(["right"] * 10, ["wrong"] * 2 + ["right"] * 8))


def test_harm_counts_where_it_is_significant():
    assert ("harmful", "one") not in worse(of_outcomes(["right"] * 400, ["wrong"] * 7 + ["right"] * 393))  # p = 2/128
    assert ("harmful", "one") in worse(of_outcomes(["right"] * 400, ["wrong"] * 8 + ["right"] * 392))  # p = 2/256


def test_files_are_compared_set_by_set_with_their_time(tmp_path):
    old = write(tmp_path / "old.jsonl", [a_record(seed=k) for k in range(3)])
    new = tmp_path / "new.jsonl.gz"
    changed = [a_record(seed=1, cpu_s=3.0), a_record(seed=2, digest="b", judgement="wrong", outcome="wrong"), a_record(seed=9)]
    new.write_bytes(gzip.compress("".join(json.dumps(r) + "\n" for r in changed).encode()))
    code, text = compared(old, new)
    assert code == 0
    assert "2 sets in both, 1 in the old file only, 1 in the new one only\n1 of 2 answers differ" in text
    assert "ratio 2.000" in text
    assert "one:2  right right traced  ->  wrong wrong traced" in text
    assert compared(old, new, "--identical")[0] == 1
    assert compared(old, old, "--identical")[0] == 0


def test_a_stopped_run_keeps_what_it_has_and_goes_on(tmp_path, monkeypatch):
    path = write(tmp_path / "r.jsonl", [a_record(seed=0)])
    with path.open("a") as out:
        out.write('{"family":"one","se')  # killed while it wrote
    asked = []

    def run(tasks, jobs, file):
        asked.extend(tasks)
        return iter([{**a_record(*task), "cpu_s": 0.123456789} for task in tasks])

    monkeypatch.setattr("bench_trace.run_all", run)
    assert trace_records.main(["record", str(path), "--family", "one", "--seeds", "0:3"]) == 0
    assert asked == [("one", 1), ("one", 2)]
    assert [*read(path)] == [("one", "0"), ("one", "1"), ("one", "2")]


def test_the_same_set_gives_the_same_record(tmp_path):
    files = [tmp_path / "a.jsonl", tmp_path / "b.jsonl"]
    for file in files:
        assert trace_records.main(["record", str(file), "--family", "tiny", "--seeds", "1"]) == 0
    assert compared(*files, "--identical")[0] == 0
    (one,) = read(files[0]).values()
    assert {"verdict", "judgement", "effects", "depends_on", "error", "cpu_s"} <= one.keys()
    assert len(one["digest"]) == 16


def test_a_digest_is_of_the_answer_and_of_the_model_only(tmp_path):
    spec = ModelSpec("unicycle", 0.1, {}, (EffectSpec("input_gain", "v", {"gain": 0.9}),), ("sha256:a",))
    answer = {"verdict": "traced", "tracer": 1, "notes": [f"read from {tmp_path}/one.csv"]}
    same = bench_trace.digest(answer, spec, tmp_path)
    moved = {**answer, "tracer": 2, "notes": ["read from /one.csv"]}
    assert same == bench_trace.digest(moved, msgspec.structs.replace(spec, fitted_on=("sha256:b",)), Path("/nowhere"))
    here, there = (msgspec.structs.replace(spec, name=f"{folder}/boat.py") for folder in ("/a", "/b/c"))
    assert bench_trace.digest(answer, here, tmp_path) == bench_trace.digest(answer, there, tmp_path)
    assert same != bench_trace.digest({**answer, "verdict": "ambiguous"}, spec, tmp_path)
    assert same != bench_trace.digest(answer, msgspec.structs.replace(spec, effects=()), tmp_path)


def test_an_unopened_set_is_counted_and_never_shown(tmp_path):
    family = bench_trace.GROUPS["unopened"][0]
    effect = {"name": "input_gain", "channel": "v", "parameters": {}}
    answer = {"depends_on": ["v"], "effects": [effect], "cpu_s": 1.0, "digest": "a", "depends_right": False}
    r = trace_records.compact({"family": family, "seed": 0, "verdict": "traced", "outcome": "false_name", **answer})
    assert (r["judgement"], r["effects"], r["depends_on"]) == ("wrong", [], [])
    old, new = write(tmp_path / "old.jsonl", [{**r, "judgement": "right", "digest": "b"}]), write(tmp_path / "new.jsonl", [r])
    _, text = compared(old, new, "--changed")
    assert "lost 1" in text
    assert f"{family}:0" not in text


def test_families_that_are_named_are_recorded_at_every_seed():
    assert bench_trace.tasks(bench_trace.ungrouped(["unopened"]), range(1, 2))[0] == (bench_trace.GROUPS["unopened"][0], 1)
    assert {family for family, _ in bench_trace.tasks([], range(1, 2))}.isdisjoint(bench_trace.GROUPS["unopened"])


def test_the_records_of_the_first_version_can_be_compared():
    path = TOOL.parent.parent / "tests" / "records" / "tracer_1.jsonl.gz"
    records = read(path)
    assert len(records) > 600
    assert path.stat().st_size < 1_000_000
    later = set(bench_trace.GROUPS["logs"])
    assert {"measured", *bench_trace.FAMILIES} - later == {family for family, _ in records}
    _, worse, differ = trace_records.compare(records, records, changed=True)
    assert (worse, differ) == (False, 0)
