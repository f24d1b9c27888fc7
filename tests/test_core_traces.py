"""When a trace is due and what may become of its result, one condition after the other."""

from __future__ import annotations

from typing import Any

import msgspec
import pytest
from core_rig import DT, Rig, S, memory, of, one
from loaded_rig import loaded
from repair_rig import FOUND, PROPOSED, traced

from s2r_runtime.messages import (
    Answer,
    InputsFinished,
    ModelAdopted,
    Output,
    RecorderChanged,
    SourceStarted,
    StartJob,
    Stopping,
    Ticked,
    TraceEnded,
)


def changed(rig: Rig, **changes: Any) -> None:
    rig.state = msgspec.structs.replace(rig.state, **changes)


def traces(outputs: list[Output]) -> list[StartJob]:
    return [job for job in of(outputs, StartJob) if job.kind == "trace"]


def excited(rig: Rig) -> list[Output]:
    """Given inputs were driven to their end."""
    rig.observe()
    rig.request("permit", duration_s=60.0)
    rig.request("excite", digest="inputs", count=1)
    rig.feed(SourceStarted(rig.t, "sampler", "inputs"))
    return rig.feed(InputsFinished(rig.t, "inputs", 1, True))


# ---------------------------------------------------------------- when


def test_inputs_can_be_traced_without_a_gap_and_the_record_says_on_what() -> None:
    rig = Rig()
    excited(rig)
    order = one(rig.request("trace", text="inputs"), StartJob)
    assert (order.stretch, order.epoch) == ("inputs", 0)
    assert rig.state.jobs[0].stretch == "inputs"
    answer = one(rig.request("trace", text="inputs"), Answer)
    assert (answer.exit_code, answer.text) == (2, "the residual is being traced already")
    ended = one(traced(rig, {"verdict": "none"}), TraceEnded)
    assert (ended.stretch, ended.epoch, ended.verdict, ended.proposal) == ("inputs", 0, "none", "")


def test_given_inputs_are_traced_once_and_not_at_the_daemons_end() -> None:
    rig = Rig(trace_after_inputs=True)
    assert [order.stretch for order in traces(excited(rig))] == ["inputs"]
    assert traces(rig.feed(InputsFinished(rig.t, "inputs", 1, True))) == []  # one is under way
    traced(rig, {"verdict": "none"})
    assert traces(rig.feed(InputsFinished(rig.t, "inputs", 0, False))) == []  # nothing was driven
    assert len(traces(rig.feed(InputsFinished(rig.t, "inputs", 1, False)))) == 1
    rig = Rig(trace_after_inputs=True)
    assert traces(excited(Rig())) == []


def test_a_campaign_that_begins_forgets_no_drive_and_a_gap_that_is_found_does() -> None:
    rig = Rig(trace_on_growth=True)
    rig.driving()
    rig.request("undeploy")
    rig.sampling()
    assert rig.state.driven
    rig.request("cancel")
    changed(rig, trace_due_ns=rig.t + 100 * S, traced_radius=0.5)
    changed(rig, deployment=None)
    rig.gap()
    assert (rig.state.driven, rig.state.trace_due_ns, rig.state.traced_radius) == (False, None, 0.0)


def test_a_gap_is_traced_where_it_was_sampled_here_and_nothing_is_being_traced() -> None:
    rig = Rig(trace_after_campaign=True)
    assert [order.stretch for order in traces(rig.gap())] == ["campaign"]
    assert traces(rig.gap()) == []  # the first is not done
    rig = Rig(trace_after_campaign=True)
    assert traces(rig.feed(loaded(4))) == []
    assert rig.state.memory.gap is not None


@pytest.mark.parametrize("notice", [{"discrepancy": 0.011}, {"discrepancy": 0.001, "change": 1e6}], ids=["growth", "change"])
def test_what_is_noticed_first_says_when_it_is_traced_and_what_comes_after_does_not_postpone_it(notice: dict[str, Any]) -> None:
    rig = Rig(trace_on_growth=True, trace_delay_ns=2 * S)
    rig.driving()
    rig.measure(**notice)
    due = rig.t + 2 * S
    assert rig.state.trace_due_ns == due
    rig.t += S
    rig.measure(0.014, change=1e6)
    assert rig.state.trace_due_ns == due
    rig.t = due - 1
    assert traces(rig.feed(Ticked(rig.t))) == []
    rig.t = due
    assert len(traces(rig.feed(Ticked(rig.t)))) == 1
    assert (rig.state.trace_due_ns, rig.state.traced_radius) == (None, 0.014)
    assert traces(rig.feed(Ticked(rig.t + DT))) == []
    rig = Rig(trace_delay_ns=2 * S)
    rig.driving()
    rig.measure(**notice)
    assert rig.state.trace_due_ns is None


def test_what_is_due_waits_for_a_trace_that_runs_and_comes_to_nothing_without_a_gap_or_a_drive() -> None:
    rig = Rig(trace_on_growth=True)
    rig.driving()
    rig.request("trace", text="drive")
    changed(rig, trace_due_ns=rig.t)
    assert traces(rig.feed(Ticked(rig.t))) == []
    assert rig.state.trace_due_ns == rig.t
    assert len(traces(traced(rig, {"verdict": "none"}))) == 1
    for gone in ({"driven": False}, {"gap": None}):
        rig = Rig(memory(), trace_on_growth=True)
        changed(rig, driven=gone.get("driven", True), trace_due_ns=rig.t)
        if "gap" in gone:
            changed(rig, memory=msgspec.structs.replace(rig.state.memory, gap=None))
        assert traces(rig.feed(Ticked(rig.t))) == []
        assert rig.state.trace_due_ns is None


# ---------------------------------------------------------------- what came of it


@pytest.mark.parametrize(
    ("trace", "known", "text"),
    [
        ({"verdict": "none"}, False, "trace of the campaign of epoch 1: none"),
        ({"verdict": "unexplained"}, False, "trace of the campaign of epoch 1: unexplained"),
        ({**FOUND, "verdict": "unexplained"}, False, "trace of the campaign of epoch 1: unexplained"),  # a partial repair
        ({"verdict": "ambiguous"}, True, "trace of the campaign of epoch 1: ambiguous"),
        ({"verdict": "traced"}, True, "trace of the campaign of epoch 1: traced"),
        (FOUND, True, "trace of the campaign of epoch 1: traced; it proposes a model: s2r adopt"),
    ],
    ids=["none", "unexplained", "partial", "ambiguous", "traced", "proposed"],
)
def test_a_finding_is_told_and_remembered(trace: dict[str, Any], known: bool, text: str) -> None:
    rig = Rig()
    rig.gap()
    rig.request("trace")
    outputs = traced(rig, trace)
    assert (one(outputs, Answer).exit_code, one(outputs, Answer).text) == (0, text)
    assert rig.state.memory.traced is known
    assert (rig.state.memory.proposal is not None) == (trace is FOUND)


@pytest.mark.parametrize(("error", "text"), [("killed", "killed"), ("", "the worker returned none")])
def test_a_trace_without_a_verdict_says_why(error: str, text: str) -> None:
    rig = Rig()
    rig.gap()
    rig.request("trace")
    outputs = traced(rig, {"verdict": 7}, error)
    assert one(outputs, Answer).text == f"no trace of the campaign: {text}"
    assert one(outputs, TraceEnded).reason == text


@pytest.mark.parametrize(
    ("effects", "named"),
    [(["a", 7, "b"], ("a", "b")), (("a",), ("a",)), ("words", ()), (None, ())],
    ids=["mixed", "tuple", "text", "nothing"],
)
def test_effects_are_named_as_far_as_they_are_words(effects: Any, named: tuple[str, ...]) -> None:
    rig = Rig()
    rig.gap()
    rig.request("trace")
    traced(rig, {"verdict": "traced", "proposal": {"digest": "better", "proposed": True, "effects": effects}})
    assert rig.state.memory.proposal is not None
    assert rig.state.memory.proposal.effects == named


def test_what_was_found_in_the_residual_of_another_model_is_not_proposed() -> None:
    rig = Rig()
    rig.gap()
    rig.request("trace")
    changed(rig, memory=msgspec.structs.replace(rig.state.memory, model_digest="newer"))
    assert one(traced(rig), TraceEnded).proposal == ""
    assert rig.state.memory.proposal is None


# ---------------------------------------------------------------- adopting


def test_a_model_is_not_adopted_while_its_residual_is_traced() -> None:
    rig = Rig()
    rig.gap()
    rig.request("trace")
    answer = one(rig.request("adopt", digest="better"), Answer)
    assert (answer.exit_code, answer.text) == (1, "refused: the worker still works with the model in force")
    traced(rig, {"verdict": "none"})
    answer = one(rig.request("adopt", digest="better"), Answer)
    assert (answer.exit_code, answer.text) == (0, "model adopted; its gap is not known yet: s2r sample")
    assert one(rig.request("adopt", digest="better"), Answer).text == "this model is in force already"


def test_the_profile_adopts_only_when_everything_is_quiet_and_can_be_recorded() -> None:
    def begin() -> Rig:
        rig = Rig(memory(), adopt="always")
        rig.observe()
        rig.request("permit", duration_s=60.0)
        return rig

    def propose(rig: Rig) -> None:
        changed(rig, memory=msgspec.structs.replace(rig.state.memory, proposal=PROPOSED))

    rig = begin()
    rig.feed(RecorderChanged(rig.t, ok=False))
    propose(rig)
    assert of(rig.feed(Ticked(rig.t)), ModelAdopted) == []
    assert one(rig.feed(RecorderChanged(rig.t, ok=True)), ModelAdopted).digest == "better"

    rig = begin()
    rig.request("sample")
    propose(rig)
    assert of(rig.feed(Ticked(rig.t)), ModelAdopted) == []
    assert len(of(rig.request("cancel"), ModelAdopted)) == 1

    rig = begin()
    rig.request("verify", digest="c")
    rig.verified()
    propose(rig)
    assert rig.state.issuing is not None
    assert of(rig.feed(Ticked(rig.t)), ModelAdopted) == []
    assert len(of(rig.stored(), ModelAdopted)) == 1

    rig = begin()
    propose(rig)
    assert of(rig.feed(Stopping(rig.t)), ModelAdopted) == []
