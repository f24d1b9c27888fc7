"""What a trace in a log says can be computed from the log, and so can what a sampler was given to drive; whoever lies is named.

The liars sign their logs with the right key, and all that follows is consistent with the lie.
"""

from __future__ import annotations

import random
import time
from collections.abc import Callable
from itertools import accumulate
from pathlib import Path
from typing import Any

import audit_bench
import msgspec
import pytest
from audit_bench import Bench, audited, entries

from s2r_runtime import messages as m
from s2r_runtime.audit import log as audit_log
from s2r_runtime.audit import traces
from s2r_runtime.audit.findings import Findings
from s2r_runtime.audit.log import audit
from s2r_runtime.audit.traces import FIRST, Traces, near, unlike
from s2r_runtime.daemon.worker import Failed, Progress, TraceJob, Worker
from s2r_runtime.modelspec import EffectSpec
from s2r_runtime.profile import parse_profile
from s2r_runtime.recording.stretches import Cut, Part, Recorded, Segment
from s2r_runtime.recording.writer import read
from s2r_runtime.trace import VERSION


def slow_robot(folder: Path, lie: str = "", memory: m.Memory | None = None) -> Any:
    """A robot that does 70 % of what it is told to, after its first campaign."""
    bench = Bench(folder, lie, memory)
    bench.gain = 0.7
    return bench.sample()


def repaired(folder: Path, lie: str = "") -> Any:
    """A campaign, a trace, the model adopted, a fresh campaign, given inputs, another trace, an end."""
    bench = slow_robot(folder, lie).trace().adopt()
    bench.ask("sample")
    while bench.state.memory.gap is None and bench.seq < 5000:
        bench.step()
    return bench.excite().trace("inputs").stop()


# ---------------------------------------------------------------- honest logs


@pytest.mark.slow
def test_traces_are_run_again_and_the_adopted_model_is_the_one_that_was_proposed(tmp_path: Path) -> None:
    result = audited(repaired(tmp_path), tmp_path / "a.mcap")
    assert result.ok, result.text()
    assert (result.skipped, result.unchecked, result.missing) == ([], [], [])
    assert result.recomputed["traces run again"] == result.recomputed["traces checked against their rows"] == 2
    assert result.recomputed["commands of given inputs"] == 60
    assert result.recomputed["gaps"] == 2
    (model,) = result.models
    assert model.adopted_by == "user 0"
    assert model.origin == "the one that trace 2 (the campaign of epoch 1) proposes; it was run again, and made it"


def test_a_persons_own_model_is_said_to_be_that(tmp_path: Path) -> None:
    bench = slow_robot(tmp_path)
    own = msgspec.structs.replace(bench.profile.model, effects=(EffectSpec("input_gain", "v", {"gain": 0.8}),))
    result = audited(bench.adopt(own).stop(), tmp_path / "a.mcap")
    assert result.ok, result.text()
    assert [one.origin for one in result.models] == ["a person's own file: no trace in these logs made it"]


@pytest.mark.slow
def test_a_trace_that_takes_long_is_skipped_and_said_so_unless_it_was_asked_for(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = slow_robot(tmp_path).trace().adopt().stop().write(tmp_path / "a.mcap")
    monkeypatch.setattr(audit_log, "SECONDS", 1e-9)
    skipped = audit([path])
    assert skipped.ok
    assert "was not run again" in skipped.skipped[0]
    assert "traces run again" not in skipped.recomputed
    assert "skipped" in skipped.text()
    assert "it was not run again" in skipped.models[0].origin
    asked = audit([path], rerun_traces=True)
    assert (asked.ok, asked.skipped, asked.recomputed["traces run again"]) == (True, [], 1)


@pytest.mark.slow
def test_a_trace_is_given_up_after_its_time_of_the_processor() -> None:
    rng = random.Random(1)
    walks = [accumulate(rng.uniform(-0.01, 0.01) for _ in range(20_000)) for _ in range(3)]
    rows = tuple((k * 33_000_000, x) for k, x in enumerate(zip(*walks, strict=True)))
    inputs = tuple((t, (rng.random(), rng.random())) for t, _ in rows)
    about = Recorded("drive", 1, (Part("a", 1, 2),), len(rows), len(rows), "digest")
    profile = parse_profile(audit_bench.PROFILE.replace("dt = 0.05", "dt = 0.033"), "profile.toml", Path())
    worker = Worker(TraceJob(profile, "drive", 1, 20_000, 0, cut=Cut(about, (Segment("a", rows, inputs),)), cpu_s=1.0), 100.0)
    said: list[Any] = []
    while not said or isinstance(said[-1], Progress):
        said += worker.poll(time.monotonic_ns())
        time.sleep(0.01)
    worker.stop()
    assert isinstance(said[-1], Failed)
    assert said[-1].text == "the worker died: killed by signal 24"


def test_a_trace_without_a_result_is_counted_as_that(tmp_path: Path) -> None:
    bench = slow_robot(tmp_path)
    bench.failing = "not done within 600 s (repair.timeout)"
    result = audited(bench.trace().stop(), tmp_path / "a.mcap")
    assert result.ok, result.text()
    assert result.recomputed["traces without a result (taken as recorded)"] == 1
    assert "traces run again" not in result.recomputed


@pytest.mark.slow
def test_a_trace_on_an_earlier_log_is_missing_without_it_and_run_again_with_it(tmp_path: Path) -> None:
    """A campaign that was interrupted by the end of one run, and went on in the next."""
    first = Bench(tmp_path)
    first.gain = 0.7
    first.step()
    first.ask("permit", duration_s=3600.0)
    first.ask("sample")
    while len(first.samples) < 6:
        first.step()
    log = first.stop().write(tmp_path / "first.mcap", run="first")
    second = Bench(tmp_path, memory=first.state.memory)
    second.gain, second.snapshot, second.samples = 0.7, first.snapshot, first.samples[:6]
    second.earlier = [log]
    second.step()
    second.ask("permit", duration_s=3600.0)
    second.ask("sample")
    while second.state.memory.gap is None and second.seq < 5000:
        second.step()
    other = second.trace().stop().write(tmp_path / "second.mcap", run="bench")
    both = audit([log, other])
    assert both.ok, both.text()
    assert both.recomputed["traces run again"] == 1
    alone = audit([other])
    assert alone.ok, alone.text()
    assert any("in an earlier log that was not given" in one for one in alone.missing)
    assert "traces run again" not in alone.recomputed


# ---------------------------------------------------------------- lies


@pytest.mark.slow
@pytest.mark.parametrize(
    ("lie", "what"),
    [
        ("trace verdict", "it ends with another verdict when it is run again"),
        ("parameter", "it ends with other effects when it is run again"),
        ("interval", "it ends with other effects when it is run again"),
        ("effects", "it ends with other effects when it is run again"),
        ("other model", "it ends with another model_toml when it is run again"),
        ("error", "it ends with another error when it is run again"),
        ("traced model", "it is of another model than the one in force"),
        ("range", "it was not made on what the log holds"),
        ("rows", "it was not made on what the log holds"),
        ("epoch", "it was not made on what the log holds"),
        ("seed", "it had another seed, or other options, than it was ordered with"),
        ("options", "it had another seed, or other options, than it was ordered with"),
        ("proposed digest", "the model that it proposes is not the one that it made"),
        ("forgetful model", "does not say what it was fitted on (guarantee G6)"),
        ("no model", "the model that it made is not attached"),
        ("no tracer", "it does not say which tracer made it"),
        ("another tracer, rows", "it had another seed, or other options, than it was ordered with"),
    ],
)
def test_a_lie_about_a_trace_is_named_where_it_stands(tmp_path: Path, lie: str, what: str) -> None:
    bench = slow_robot(tmp_path, lie).trace().stop()
    result = audited(bench, tmp_path / "a.mcap")
    assert not result.ok
    assert result.first_difference is not None
    assert "trace 2 (the campaign of epoch 1)" in result.first_difference.what
    assert what in result.first_difference.what
    assert result.first_difference.channel == "event/job_finished"
    (at,) = [entry.index for entry in entries(tmp_path / "a.mcap") if isinstance(entry.message, m.JobFinished) and entry.message.trace]
    assert result.first_difference.index == at


def test_a_trace_by_another_tracer_has_its_rows_checked_and_its_answer_left(tmp_path: Path) -> None:
    result = audited(slow_robot(tmp_path, "another tracer").trace().stop(), tmp_path / "a.mcap")
    assert result.ok, result.text()
    by = f"by another tracer (version {VERSION + 1}, here {VERSION})"
    assert result.skipped == [f"trace 2 (the campaign of epoch 1) was made {by}: its rows were checked, its answer was not recomputed"]
    assert result.recomputed["traces checked against their rows"] == 1
    assert "traces run again" not in result.recomputed
    assert "made by another tracer" in result.text()


def test_what_another_tracer_made_and_a_person_adopted_is_said_to_be_that(tmp_path: Path) -> None:
    result = audited(slow_robot(tmp_path, "another tracer").trace().adopt().stop(), tmp_path / "a.mcap")
    assert "made by another tracer" in result.models[0].origin


def test_a_trace_that_states_no_tracer_is_of_the_first_one(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    honest = audit_bench.trace_job.trace

    def unstated(*given: Any) -> dict[str, Any]:
        return {key: value for key, value in honest(*given).items() if key != "tracer"}

    monkeypatch.setattr(audit_bench, "TRACED", {})
    monkeypatch.setattr(audit_bench.trace_job, "trace", unstated)
    bench = slow_robot(tmp_path).trace().stop()
    monkeypatch.undo()
    result = audited(bench, tmp_path / "a.mcap")
    assert result.ok, result.text()
    if VERSION == FIRST:
        assert result.recomputed["traces run again"] == 1
    else:
        assert f"(version {FIRST}, here {VERSION})" in result.skipped[0]


@pytest.mark.slow
def test_a_gap_on_what_the_fit_has_seen_is_named(tmp_path: Path) -> None:
    """The samples of the first campaign are logged once more, as if an interruption of the second had cut them off."""
    bench = slow_robot(tmp_path, "old samples").trace().adopt()
    bench.ask("sample")
    bench.steps(40)
    bench.interrupt()
    while bench.state.memory.gap is None and bench.seq < 5000:
        bench.step()
    result = audited(bench.stop(), tmp_path / "a.mcap")
    assert not result.ok
    assert result.first_difference is not None
    assert "a sample is logged once more, but its campaign began here" in result.first_difference.what


def test_no_sample_of_a_gap_is_a_transition_of_the_rows_that_its_model_was_fitted_on(tmp_path: Path) -> None:
    bench = slow_robot(tmp_path).trace()
    path = bench.write(tmp_path / "a.mcap")
    found = Traces(Findings(), seconds=30.0, progress=lambda _: None)
    found.begin_run("bench", b"", 40_000, m.Memory("bench", 1))
    attached: dict[str, Any] = {item[0]: Attached(*item) for item in bench.items if isinstance(item, tuple)}
    for entry in read(path):
        if entry.channel in traces.RELEVANT:
            found.take(entry, entry.message)
        elif isinstance(entry.message, m.JobFinished) and entry.message.trace is not None:
            found.finished(entry, entry.message, bench.profile, bench.model.states, attached, runnable=False)
    (made,) = [spec for spec in bench.models.values() if spec.effects]
    dt_ns = 50_000_000
    assert "guarantee G6" in found.seen_by_the_fit(made, bench.samples[3:4], dt_ns)
    assert found.seen_by_the_fit(bench.profile.model, bench.samples, dt_ns) == "", "of another model"
    fresh = [msgspec.structs.replace(sample, t0_ns=sample.t0_ns + 10**12) for sample in bench.samples]
    assert found.seen_by_the_fit(made, fresh, dt_ns) == ""


class Attached:
    """As a log has it."""

    def __init__(self, name: str, media_type: str, data: bytes) -> None:
        self.name, self.media_type, self.data = name, media_type, data


def excited(folder: Path, lie: str = "") -> Any:
    bench = Bench(folder, lie)
    bench.step()
    bench.ask("permit", duration_s=3600.0)
    return bench.excite().stop()


def test_a_command_that_is_not_the_files_is_named(tmp_path: Path) -> None:
    bench = excited(tmp_path, "given input")
    assert bench.lie_at >= 0
    result = audited(bench, tmp_path / "a.mcap")
    assert result.first_difference is not None
    assert "this is not the next row of the inputs that are attached" in result.first_difference.what
    assert result.first_difference.index == entries(tmp_path / "a.mcap")[bench.lie_at].index


@pytest.mark.parametrize(
    ("change", "what"),
    [
        (lambda data: data.replace(b"t,v,w", b"t,w,v"), "are not those that were driven"),
        (None, "are not attached"),
    ],
    ids=["another file", "no file"],
)
def test_given_inputs_that_are_not_attached_are_missed(tmp_path: Path, change: Callable[[bytes], bytes] | None, what: str) -> None:
    bench = excited(tmp_path)
    at = next(i for i, item in enumerate(bench.items) if isinstance(item, tuple) and item[0].startswith("inputs/"))
    name, kind, data = bench.items[at]
    bench.items[at : at + 1] = [] if change is None else [(name, kind, change(data))]
    result = audited(bench, tmp_path / "a.mcap")
    assert not result.ok
    assert result.first_difference is not None
    assert what in result.first_difference.what


def test_inputs_that_ended_before_their_last_row_are_said_to(tmp_path: Path) -> None:
    bench = Bench(tmp_path)
    bench.step()
    bench.ask("permit", duration_s=1.0)
    result = audited(bench.excite().stop(), tmp_path / "a.mcap")
    assert result.ok, result.text()
    assert 0 < result.recomputed["commands of given inputs"] < 60
    (ended,) = [item for item in bench.items if isinstance(item, m.InputsFinished)]
    assert (ended.complete, ended.detail) == (False, "permit_expired")


# ---------------------------------------------------------------- on another machine


def test_on_another_machine_numbers_may_differ_in_the_sixth_digit_and_nothing_else(tmp_path: Path) -> None:
    slow_robot(tmp_path).trace()
    honest = msgspec.json.decode(msgspec.json.encode(next(t for t in audit_bench.TRACED.values() if t["effects"])))

    def changed(factor: float) -> dict[str, Any]:
        text = honest["model_toml"]
        gain = honest["effects"][0]["parameters"]["gain"]["value"]
        return {
            **honest,
            "effects": audit_bench._effect(honest, value=gain * factor),
            "model_toml": text.replace(repr(gain), repr(gain * factor)),
        }

    assert unlike(honest, changed(1.0), exact=True) == ""
    assert unlike(honest, changed(1 + 1e-9), exact=False) == ""
    assert unlike(honest, changed(1 + 1e-9), exact=True) != ""
    assert unlike(honest, changed(1 + 1e-4), exact=False) == "it ends with other effects when it is run again"
    assert "another model" in unlike(honest, {**honest, "model_toml": changed(1 + 1e-4)["model_toml"]}, exact=False)
    assert "another verdict" in unlike(honest, {**honest, "verdict": "none"}, exact=False)
    assert near([1.0, {"a": [2.0, "x", True]}], [1.0 + 1e-7, {"a": [2.0, "x", True]}])
    for other in ([1.0, 2.0], [True], ["x"], [1.1], {"a": 1.0}, [None]):
        assert not near([1.0], other)
