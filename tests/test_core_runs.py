"""Every run of a certified controller is counted, whatever ended it, and limits that hold at all times rest on the counts (G10)."""

from __future__ import annotations

import math
from typing import Any

import msgspec
import pytest
from core_rig import Rig, answers, of, one

from s2r_runtime.core import anytime, runs
from s2r_runtime.core import reducer as core
from s2r_runtime.messages import (
    EPISODES,
    CertificateStored,
    EpisodeCounted,
    EpisodeEnded,
    EpisodeScored,
    IssueCertificate,
    LinkChanged,
    Memory,
    Persist,
    RecorderChanged,
    Revoked,
    SourceStarted,
    SourceStopped,
    StartController,
    StartJob,
    Stopping,
)

BETA = 0.1


def driving(memory: Memory | None = None, **changes: Any) -> Rig:
    """A controller that drives, at the beginning of a scenario that it drives from its start."""
    rig = Rig(memory, **{"beta_episodes": BETA, **changes})
    rig.driving()
    ended(rig)
    steps(rig)
    return rig


def steps(rig: Rig, count: int = 3) -> None:
    for _ in range(count):
        rig.observe()
        rig.propose()


def ended(rig: Rig, safety: float = 0.5, detail: str = "") -> list[Any]:
    """The scenario ends with the newest observation, whose question is open."""
    rig.observe()
    outputs = rig.feed(EpisodeEnded(rig.t, core.status(rig.state)["episodes"], 200, safety, 1.0, detail))  # type: ignore[arg-type]
    if rig.state.deployment is not None:
        rig.propose()
    return outputs


def counted(rig: Rig) -> list[tuple[str, str]]:
    """Outcome and reason of every run after the first, which began while the gate was settling."""
    return [(one.outcome, one.reason) for one in of(rig.outputs, EpisodeCounted)][1:]


def test_a_run_that_began_while_the_gate_settled_is_left_out_and_the_next_one_counts() -> None:
    rig = driving()
    (first,) = of(rig.outputs, EpisodeCounted)
    assert (first.outcome, first.reason, first.limits) == ("left_out", "not driven from its start", ())
    assert rig.state.memory.runs == ()
    (counts,) = of(ended(rig), EpisodeCounted)
    assert (counts.outcome, counts.controller, counts.certificate, counts.safety) == ("safe", "controller", "c1", 0.5)
    whole, own = counts.limits
    assert (whole.n, whole.unsafe, whole.censored, whole.number, whole.certificate, own.certificate) == (1, 0, 0, 1, "", "c1")
    assert (whole.lower, whole.upper) == anytime.limits(anytime.Counts(1), whole.beta_lower, whole.beta_upper)
    assert whole.beta_lower + whole.beta_upper == pytest.approx(6.0 * BETA / math.pi**2)
    assert whole.beta_upper == pytest.approx(3.0 * whole.beta_lower)
    assert (counts.index, counts.steps, first.index) == (1, 200, 0)


@pytest.mark.parametrize(
    ("safety", "detail", "threshold", "outcome"),
    [(0.0, "", 0.0, "safe"), (-1e-9, "", 0.0, "unsafe"), (0.1, "", 0.2, "unsafe"), (0.0, "no safety, no progress", -1.0, "unsafe")],
)
def test_a_whole_run_is_unsafe_below_the_threshold(safety: float, detail: str, threshold: float, outcome: str) -> None:
    rig = driving(threshold=threshold)
    (counts,) = of(ended(rig, safety, detail), EpisodeCounted)
    assert counts.outcome == outcome
    assert counts.safety == (None if detail else safety)


@pytest.mark.parametrize("kind", ["unsafe", "safe", "censored"])
def test_a_closing_counts_as_the_profile_says_and_once_a_scenario(kind: Any) -> None:
    rig = driving(gate_closing=kind)
    rig.observe((5.0, 0.0, 0.0))
    steps(rig, 12)  # the gate opens again within the scenario
    assert rig.state.gate_open
    rig.feed(LinkChanged(rig.t, up=False))
    rig.feed(LinkChanged(rig.t, up=True))
    steps(rig, 12)
    ended(rig)
    assert counted(rig) == [(kind, "the gate closed: outside_region")]


def test_a_closing_is_unsafe_whatever_the_profile_says_once_the_safety_value_was_below_the_threshold() -> None:
    rig = driving(gate_closing="safe")
    rig.observe()
    rig.feed(EpisodeScored(rig.t, 1, 4, -0.2, below=True))
    rig.propose()
    rig.observe((5.0, 0.0, 0.0))
    rig.request("undeploy")
    assert counted(rig) == [("unsafe", "its safety value is below the threshold")]
    last = of(rig.outputs, EpisodeCounted)[-1]
    assert (last.index, last.steps, last.safety) == (1, 4, -0.2)


def test_a_safety_value_that_recovers_is_judged_at_the_end() -> None:
    rig = driving()
    for below in (True, False):
        rig.observe()
        rig.feed(EpisodeScored(rig.t, 1, 4, -0.2 if below else 0.3, below=below))
        rig.propose()
    rig.request("undeploy")
    assert counted(rig) == [("censored", "a person ended it (undeploy)")]


@pytest.mark.parametrize("reason", ["raised", "died", "deadline", "malformed"])
def test_a_controller_that_fails_has_an_unsafe_run_whatever_closings_count_as(reason: Any) -> None:
    rig = driving(gate_closing="safe")
    rig.observe()
    rig.feed(SourceStopped(rig.t, "controller", reason))
    assert counted(rig) == [("unsafe", f"the controller failed: {reason}")]


def test_a_controller_that_ends_by_itself_within_a_run_closes_the_gate() -> None:
    for reason in ("finished", "stopped"):
        rig = driving(gate_closing="censored")
        rig.observe()
        rig.feed(SourceStopped(rig.t, "controller", reason))  # type: ignore[arg-type]
        assert counted(rig) == [("censored", "the gate closed: no_controller")]


def test_a_controller_that_fails_at_the_first_step_has_an_unsafe_run() -> None:
    rig = Rig(beta_episodes=BETA)
    rig.deployed()
    rig.observe()
    rig.feed(SourceStopped(rig.t, "controller", "raised"))
    assert [one.outcome for one in of(rig.outputs, EpisodeCounted)] == ["unsafe"]


def test_a_command_that_the_gate_rejects_is_a_closing_from_the_first_step_on() -> None:
    for before, expected in ((0, "unsafe"), (3, "unsafe")):
        rig = Rig(beta_episodes=BETA)
        rig.driving()
        rig.observe()
        rig.feed(EpisodeEnded(rig.t, 0, 200, 0.5, 1.0))
        for _ in range(before):
            rig.propose()
            rig.observe()
        rig.propose(u=(9.0, 0.0))
        rig.request("undeploy")
        assert counted(rig) == [(expected, "the gate closed: input_out_of_bounds")]


@pytest.mark.parametrize("lockstep", [False, True])
def test_a_gate_that_closes_before_the_first_answer_of_a_scenario_makes_a_run(lockstep: bool) -> None:
    rig = driving(lockstep=lockstep)
    rig.observe()
    rig.feed(EpisodeEnded(rig.t, 1, 200, 0.5, 1.0))
    rig.feed(LinkChanged(rig.t, up=False))
    rig.request("undeploy")
    assert counted(rig) == [("safe", "the scenario came to its end"), ("unsafe", "the gate closed: link_down")]
    assert of(rig.outputs, EpisodeCounted)[-1].index == 2


def test_a_scenario_that_begins_while_the_gate_settles_is_left_out_also_after_the_first() -> None:
    rig = driving()
    rig.observe((5.0, 0.0, 0.0))
    rig.observe()
    rig.feed(EpisodeEnded(rig.t, 1, 200, 0.5, 1.0))
    rig.propose()
    steps(rig, 8)
    ended(rig)
    assert counted(rig) == [("unsafe", "the gate closed: outside_region"), ("left_out", "not driven from its start")]


def test_a_command_that_is_rejected_in_a_run_that_the_controller_never_took_over_changes_nothing() -> None:
    rig = Rig(beta_episodes=BETA)
    rig.deployed()
    rig.observe()
    rig.propose()
    rig.observe()
    rig.propose(u=(9.0, 0.0))
    rig.request("undeploy")
    (found,) = of(rig.outputs, EpisodeCounted)
    assert (found.outcome, found.reason, found.limits) == ("left_out", "not driven from its start", ())
    assert rig.state.memory.run_sequences == 0


def test_a_controller_that_commanded_nothing_had_no_run() -> None:
    rig = Rig(beta_episodes=BETA)
    rig.deployed()
    rig.request("undeploy")
    assert of(rig.outputs, EpisodeCounted) == []
    assert rig.state.memory.open_run is None


def test_the_status_is_of_the_controller_that_drove_last_when_none_drives() -> None:
    rig = driving()
    ended(rig)
    rig.request("undeploy")
    shown: Any = core.status(rig.state)["runs"]
    assert (shown["controller"], shown["all"]["n"], shown["under_certificate"]) == ("controller", 2, None)
    rig.deploying("another")
    shown = core.status(rig.state)["runs"]
    assert (shown["controller"], shown["all"], shown["under_certificate"]) == ("another", None, None)


def test_the_end_of_all_scenarios_is_the_end_of_no_run() -> None:
    rig = driving()
    rig.observe()
    rig.feed(EpisodeEnded(rig.t, 1, 200, 0.5, 1.0))
    rig.feed(SourceStopped(rig.t, "controller", "finished"))
    assert counted(rig) == [("safe", "the scenario came to its end")]
    assert rig.state.run is None
    assert rig.state.memory.open_run is None


def test_what_a_person_or_the_daemon_ends_is_censored() -> None:
    for end, why in (
        (lambda rig: rig.request("undeploy"), "a person ended it (undeploy)"),
        (lambda rig: rig.request("revoke"), "a person ended it (revoke)"),
        (lambda rig: rig.feed(Stopping(rig.t, "SIGTERM")), "the daemon ended"),
    ):
        rig = driving()
        end(rig)
        assert counted(rig) == [("censored", why)]
        (whole, _) = of(rig.outputs, EpisodeCounted)[-1].limits
        assert (whole.n, whole.unsafe, whole.censored) == (1, 0, 1)
        assert whole.upper == anytime.upper(1, 1, whole.beta_upper)
        assert whole.lower == 0.0


def test_an_emergency_stop_is_a_closing() -> None:
    rig = driving()
    rig.request("stop")
    assert counted(rig) == [("unsafe", "the gate closed: emergency_stop")]


def test_what_nobody_can_compute_from_the_log_is_censored() -> None:
    rig = driving(gate_closing="safe")
    rig.feed(RecorderChanged(rig.t, ok=False, detail="disk full"))
    rig.request("undeploy")
    assert counted(rig) == [("censored", "the gate closed: recorder_down")]
    rig = driving(gate_closing="safe")
    rig.observe(after=-5_000_000_000)
    rig.request("undeploy")
    assert counted(rig) == [("censored", "the gate closed: clock_backwards")]


def test_a_closing_counts_also_where_no_recovery_command_was_due_before_a_person_ended_the_run() -> None:
    rig = driving(lockstep=True)
    rig.feed(RecorderChanged(rig.t, ok=False, detail="disk full"))
    rig.request("undeploy")
    assert counted(rig) == [("censored", "the gate closed: recorder_down")]
    rig = driving(lockstep=True)
    rig.request("undeploy")
    assert counted(rig) == [("censored", "a person ended it (undeploy)")]


def test_a_run_that_was_taken_over_late_counts_as_censored_where_something_went_wrong_in_it() -> None:
    rig = Rig(beta_episodes=BETA)
    rig.driving()
    rig.observe((5.0, 0.0, 0.0))
    rig.observe()
    rig.request("undeploy")
    (counts,) = of(rig.outputs, EpisodeCounted)
    assert (counts.outcome, counts.reason) == ("censored", "not driven from its start, and the gate closed: outside_region")


def test_a_run_that_a_crash_cut_counts_as_censored_at_the_next_start() -> None:
    rig = driving()
    ended(rig)
    memory = of(rig.outputs, Persist)[-1].memory  # what the log ends with; the daemon is killed here
    assert memory.open_run is not None
    again = Rig(memory, beta_episodes=BETA)
    (counts,) = of(again.outputs, EpisodeCounted)
    assert (counts.outcome, counts.reason) == ("censored", "the daemon was cut while this controller drove")
    assert (counts.limits[0].n, counts.limits[0].censored) == (2, 1)
    assert again.state.memory.open_run is None
    assert again.state.memory.drives == memory.drives + 1 == 2
    assert of(Rig(again.state.memory, beta_episodes=BETA).outputs, EpisodeCounted) == []
    without = Rig(memory)
    assert of(without.outputs, EpisodeCounted) == []
    assert without.state.memory.open_run == memory.open_run, "it counts when runs are counted again"


def test_the_open_run_is_durable_before_the_controller_starts() -> None:
    rig = Rig(beta_episodes=BETA)
    rig.gap()
    outputs = rig.deploying()
    start = outputs.index(one(outputs, StartController))
    kept = [output for output in outputs[:start] if isinstance(output, Persist)]
    assert kept[-1].memory.open_run is not None
    assert not kept[-1].later


def test_nothing_waits_for_the_disk_when_a_run_is_counted() -> None:
    rig = driving()
    (kept,) = of(ended(rig), Persist)
    assert kept.later
    assert kept.memory.runs[0].n == 1


def test_each_controller_and_each_later_certificate_has_a_share_of_its_own() -> None:
    rig = driving()
    ended(rig)
    rig.request("undeploy")
    first = rig.state.memory.runs
    assert [(run.certificate, run.number) for run in first] == [("", 1), ("c1", 1)]
    rig.request("revoke", text="c1")
    deployed_again(rig, "controller")
    ended(rig)
    second = {run.certificate: run for run in rig.state.memory.runs}
    assert {name: (run.number, run.n) for name, run in second.items()} == {"": (1, 3), "c2": (2, 1)}
    whole, own = of(rig.outputs, EpisodeCounted)[-1].limits
    for found in (whole, own):
        counts = anytime.Counts(found.n, found.unsafe, found.censored)
        assert (found.lower, found.upper) == anytime.limits(counts, found.beta_lower, found.beta_upper)
    assert (whole.n, whole.censored, own.n, own.censored) == (3, 1, 1, 0)
    assert own.beta_upper == pytest.approx(0.25 * whole.beta_upper)
    rig.request("undeploy")
    deployed_again(rig, "another")
    ended(rig)
    third = {(run.controller, run.certificate): (run.number, run.n) for run in rig.state.memory.runs}
    assert third == {("controller", ""): (1, 4), ("controller", "c2"): (2, 2), ("another", ""): (3, 1), ("another", "c3"): (3, 1)}
    assert rig.state.memory.run_sequences == 3
    rig.request("undeploy")
    shown: Any = core.status(rig.state)["runs"]
    assert (shown["controller"], shown["all"]["n"]) == ("another", 2), "the one that drove last"
    assert math.fsum(runs.share(BETA, number) for number in range(1, 100_000)) == pytest.approx(BETA, rel=1e-5)


def deployed_again(rig: Rig, digest: str) -> None:
    rig.deploying(digest)
    rig.feed(SourceStarted(rig.t, "controller", digest))
    steps(rig, 8)
    ended(rig)
    steps(rig)


def test_a_certificate_whose_controller_drove_under_another_begins_again_from_nothing() -> None:
    rig = driving()
    ended(rig)
    memory = rig.state.memory
    own = memory.runs[1]
    changed = (runs.RunCounts("controller", "", 1, own.beta, 5), own)
    found = runs._sequences(msgspec.structs.replace(memory, runs=changed), rig.settings, "controller", "c1")
    assert (found[0], found[1].n, found[2].number, found[2].n) == (2, 5, 2, 0)


def test_a_lower_limit_above_the_profile_s_revokes_and_refuses_until_a_person_clears_it() -> None:
    rig = driving(max_unsafe=0.01)
    drove = 0
    while rig.state.deployment is not None:
        ended(rig, -0.1)
        drove += 1
        assert drove < 10
    assert [(one.certificate_id, one.reason) for one in of(rig.outputs, Revoked)] == [("c1", "unsafe_runs")]
    limits = of(rig.outputs, EpisodeCounted)[-1].limits[0]
    assert (limits.n, limits.unsafe) == (drove, drove)
    assert limits.lower > 0.01 >= anytime.lower(drove - 1, drove - 1, limits.beta_lower)
    assert rig.state.memory.runs[0].exceeded
    assert not rig.state.gate_open
    for verb in ("deploy", "verify"):
        outputs = rig.request(verb, digest="controller")
        assert of(outputs, StartJob) == []
        (answer,) = answers(rig)[rig.requests]
        assert answer.exit_code == 1
        assert answer.text.startswith(
            f"refused: unsafe_runs: of {drove} runs of this controller on this robot {drove} were unsafe, at least"
        )
    again = Rig(rig.state.memory, beta_episodes=BETA, max_unsafe=0.01)
    again.observe()
    again.request("deploy", digest="controller")
    assert answers(again)[1][0].exit_code == 1
    assert runs.refusal(rig.state.memory, Rig().settings, "controller") == "", "a profile without a limit refuses nothing"
    assert runs.refusal(rig.state.memory, rig.settings, "another") == ""
    outputs = again.request("clear", text="unsafe_runs")
    assert isinstance(outputs[0], Persist), "before anybody hears of it"
    assert outputs[0].memory.runs == ()
    assert not outputs[0].later
    assert of(again.request("deploy", digest="controller"), StartJob)
    assert (again.state.memory.runs, again.state.memory.run_sequences, again.state.memory.runs_cleared) == ((), 1, 1)
    again.request("clear", text="unsafe_runs")
    assert answers(again)[again.requests][0].exit_code == 2


def test_a_certificate_of_a_refused_controller_is_not_loaded() -> None:
    rig = driving(max_unsafe=0.01)
    while rig.state.deployment is not None:
        ended(rig, -0.1)
    facts = of(rig.outputs, StartController)
    assert facts
    gap = rig.state.memory.gap
    assert gap is not None
    loaded = _facts(rig, "brought")
    outputs = rig.feed(CertificateStored(rig.t, loaded, gap, 77))
    assert "unsafe_runs" in outputs[0].text  # type: ignore[union-attr]
    assert rig.state.memory.certificates == ()


def _facts(rig: Rig, identity: str) -> Any:
    from s2r_runtime.messages import CertificateFacts

    return CertificateFacts(identity, "controller", "model", "task", "profile", 1, 0.01, 0.015, 1500, 2500, 9)


def test_without_a_limit_nothing_is_revoked() -> None:
    rig = driving()
    for _ in range(10):
        ended(rig, -0.1)
    assert of(rig.outputs, Revoked) == []
    assert not any(run.exceeded for run in rig.state.memory.runs)
    shown: Any = core.status(rig.state)["runs"]
    assert (shown["all"]["n"], shown["all"]["unsafe"], shown["max_unsafe"], shown["refused"]) == (10, 10, None, False)
    assert shown["under_certificate"] == {**shown["all"], "certificate": "c1"}


def test_a_certificate_is_issued_with_the_limits_as_they_stand() -> None:
    rig = driving()
    assert of(rig.outputs, IssueCertificate)[-1].run_limits is None
    ended(rig)
    limits = of(rig.outputs, EpisodeCounted)[-1].limits[0]
    rig.request("verify", digest="controller")
    rig.verified()
    assert one(rig.outputs, IssueCertificate, last=True).run_limits == limits


def test_runs_of_before_and_runs_without_a_budget_are_not_counted() -> None:
    for changes in ({"rules": EPISODES - 1, "beta_episodes": BETA}, {"beta_episodes": 0.0}):
        rig = Rig(**changes)
        rig.driving()
        ended(rig)
        ended(rig)
        assert of(rig.outputs, EpisodeCounted) == []
        assert rig.state.memory.open_run is None
        assert core.status(rig.state)["runs"] is None


def test_runs_under_another_certificate_in_force_and_of_other_controllers_are_kept() -> None:
    memory = driving().state.memory
    other = msgspec.structs.replace(memory.certificates[0], id="other")
    before = tuple(
        runs.RunCounts(*names, 1, 0.06, 3) for names in (("a", ""), ("controller", ""), ("controller", "other"), ("controller", "old"))
    )
    memory = msgspec.structs.replace(memory, certificates=(*memory.certificates, other), runs=before)
    whole, own = runs.RunCounts("controller", "", 1, 0.06, 4), runs.RunCounts("controller", "c1", 2, 0.02, 1)
    assert runs._kept(memory, whole, own) == (before[0], before[2], whole, own)
    exceeded = tuple(msgspec.structs.replace(one, exceeded=one.controller == "a") for one in before)
    rig = Rig(msgspec.structs.replace(memory, runs=exceeded), beta_episodes=BETA, max_unsafe=0.01)
    rig.request("clear", text="unsafe_runs")
    assert {run.controller for run in rig.state.memory.runs} == {"controller"}


def test_the_number_of_controllers_that_are_remembered_is_bounded_and_refused_ones_stay_longest() -> None:
    many = tuple(runs.RunCounts(f"k{i}", "", i + 1, 0.01, 3, exceeded=i == 0) for i in range(runs.CONTROLLERS))
    memory = msgspec.structs.replace(driving().state.memory, runs=many)
    kept = runs._kept(memory, runs.RunCounts("new", "", 300, 0.01), runs.RunCounts("new", "c", 300, 0.01))
    names = [one.controller for one in kept if not one.certificate]
    assert len(names) == runs.CONTROLLERS
    assert (names[0], names[1], names[-1]) == ("k0", "k2", "new")
