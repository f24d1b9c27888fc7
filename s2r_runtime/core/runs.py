"""Runs of certified controllers on the robot, counted, with limits that hold after every run (guarantee G10, `anytime`).

A run is a scenario that the controller drives. It begins with the controller's first command in it, and ends with the scenario
(`EpisodeEnded`), with a closing of the gate, or with the deployment. What it counts as, the first line that applies:

    the controller failed (raised, died, no answer)        unsafe
    safety value below the threshold                       unsafe
    the gate closed, or rejected a command                 `Settings.gate_closing`; censored for the reasons in `CENSORED`
    the scenario came to its end                           safe
    a person or the daemon's end cut it                    censored

A run that the controller did not drive from its start (the gate still settled) is left out, which is decided before its outcome. Where
something went wrong in it, it counts as censored all the same: 1 in the upper limit, 0 in the lower one, so both limits stay valid.
The same holds for a run that a crash cut: `Memory.open_run` is durable before a controller starts, and counts at the next start.

Each controller has a sequence of runs over all certificates, and each certificate one of its own. Sequence number i of this robot has the
share 6 beta / (pi^2 i^2) of `Settings.beta_episodes`: a quarter for the lower limit, three quarters for the upper one. A controller's
first certificate shares the controller's sequence for as long as both hold the same runs: one event, paid once. Afterwards it begins again
from nothing with a number of its own. A lower limit above `Settings.max_unsafe` revokes, and the controller is refused until a person
clears it: `s2r clear unsafe_runs`.
"""

from __future__ import annotations

from typing import Literal

import msgspec

from s2r_runtime.core import anytime, ledger
from s2r_runtime.core.state import Run, Turn
from s2r_runtime.messages import (
    EPISODES,
    Ask,
    Decided,
    EpisodeCounted,
    EpisodeEnded,
    EpisodeScored,
    Event,
    GateChanged,
    Memory,
    OpenRun,
    Requested,
    RunCounts,
    RunLimits,
    Send,
    Settings,
    SourceStopped,
    StartController,
    Stopping,
)

REASON = "unsafe_runs"
LOWER_SHARE = 0.25
"""Of a sequence's share, for the limit that revokes. The upper limit is what a person reads: it has the larger part."""
CENSORED = ("clock_backwards", "recorder_down")
"""Closings after which nobody can compute the run from the log."""
BY_PERSON = ("undeploy", "revoke", "pause")
"""Requests that end a run without anything having gone wrong in it."""
CONTROLLERS = 200
"""Controllers whose runs are remembered: some 40 KB of what is persisted. One that returns after that begins a new sequence, with a new
share. Those that exceeded the limit are discarded last."""

Outcome = Literal["safe", "unsafe", "censored", "left_out"]


def counted(settings: Settings) -> bool:
    """Whether runs are counted here: not in a log of before, nor without a budget."""
    return settings.rules >= EPISODES and settings.beta_episodes > 0.0


# ---------------------------------------------------------------- a run


def begin(turn: Turn, controller: str, certificate: str) -> None:
    """A controller is to start: whatever happens to the daemon from here on, its run counts."""
    if counted(turn.settings):
        turn.remember(open_run=OpenRun(controller, certificate), drives=turn.memory.drives + 1)
        turn.persist()


def restored(turn: Turn) -> None:
    """A daemon starts: a run that was in progress when the one before it ended was cut."""
    cut = turn.memory.open_run
    if cut is not None and counted(turn.settings):
        turn.remember(open_run=None, drives=turn.memory.drives + 1)
        _count(turn, Run(cut.controller, cut.certificate), "censored", "the daemon was cut while this controller drove")


def scored(turn: Turn, event: EpisodeScored) -> None:
    """The scenario's safety value crossed the threshold."""
    run = turn.state.run
    if run is not None:
        safety = None if event.detail else event.safety
        turn.set(run=msgspec.structs.replace(run, index=event.index, steps=event.steps, safety=safety, below=event.below))


def ended(turn: Turn, event: EpisodeEnded) -> None:
    """The scenario came to its end; the next one begins at the same observation."""
    run = turn.state.run
    if run is None:
        return
    safety = None if "safety" in event.detail else event.safety
    below = safety is None or safety < turn.settings.threshold
    done = msgspec.structs.replace(run, index=event.index, steps=event.steps, safety=safety, below=below)
    turn.set(run=Run(run.controller, run.certificate, index=event.index + 1, open=run.open, shown=True, settled=run.settled))
    _conclude(turn, done, "")
    if refusal(turn.memory, turn.settings, run.controller):  # it is revoked next, which is no fault of the scenario that would begin
        turn.set(run=None)


def stopped(turn: Turn, event: SourceStopped) -> None:
    """The controller is gone. Before the deployment ends with it."""
    run = turn.state.run
    if event.source != "controller" or run is None:
        return
    if event.reason == "finished" and run.from_start is None:  # all scenarios are over, and no other one began
        turn.set(run=None)
    elif event.reason not in ("finished", "stopped") and run.shown:
        turn.set(run=msgspec.structs.replace(run, failed=event.reason))


def follow(turn: Turn, event: Event) -> None:
    """At the end of every event: what the gate and the robot were commanded says how the run stands."""
    if not counted(turn.settings):
        return
    cut = _cut_by(event)
    for output in tuple(turn.outputs):
        run = turn.state.run
        match output:
            case StartController():
                first = 0 if output.scenarios is None else output.scenarios.first
                turn.set(run=Run(output.digest, output.certificate_id, index=first))
            case _ if run is None:
                pass
            case Ask(source="controller"):
                turn.set(run=msgspec.structs.replace(run, shown=True, settled=run.open))
            case GateChanged():
                turn.set(run=_gate_changed(run, output, cut))
            case Decided(source="controller", allow=False) if output.reason != "settling":
                turn.set(run=_refused(run, output.reason))
            case Send():
                turn.set(run=_sent(run, output, cut))
            case _:
                pass
    deployment = turn.state.deployment
    if deployment is None or deployment.stage == "verifying":
        last = turn.state.run
        turn.set(run=None)
        if turn.memory.open_run is not None:
            turn.remember(open_run=None, drives=turn.memory.drives + 1)
        if last is not None:
            _conclude(turn, last, cut or "the deployment ended")


def _cut_by(event: Event) -> str:
    """Who ends a run with this event although nothing went wrong in it; or empty."""
    if isinstance(event, Stopping):
        return "the daemon ended"
    if isinstance(event, Requested) and event.verb in BY_PERSON:
        return f"a person ended it ({event.verb})"
    return ""


def _gate_changed(run: Run, output: GateChanged, cut: str) -> Run:
    closes = run.open and not output.open and run.took_over and not cut
    closed = run.closed or (output.reason if closes else "")
    return msgspec.structs.replace(run, open=output.open, closed=closed, said="" if output.open else run.said or output.reason)


def _refused(run: Run, reason: str) -> Run:
    """The gate rejected the controller's first command, for another reason than that it settles. (A later one: the gate closes.)"""
    if not run.shown or run.from_start is not None:
        return run
    return msgspec.structs.replace(run, closed=reason, from_start=True)


def _sent(run: Run, send: Send, cut: str) -> Run:
    """The robot was commanded, by somebody."""
    if not run.shown:
        return run
    mine = send.source == "controller"
    if mine:
        from_start = True if run.from_start is None else run.from_start
        return msgspec.structs.replace(run, from_start=from_start, took_over=True)
    if cut or run.failed:
        return run
    if run.from_start is None:
        closed = (run.said or "no command in time") if run.settled else ""
        return msgspec.structs.replace(run, from_start=run.settled, closed=run.closed or closed)
    if run.took_over:
        return msgspec.structs.replace(run, closed=run.closed or run.said or "no command in time")
    return run


def _conclude(turn: Turn, run: Run, cut: str) -> None:
    """A run is over. cut: why it did not come to its own end, or empty."""
    if run.from_start is None and not run.failed:
        return  # the controller commanded nothing in it
    _count(turn, run, *_outcome(run, turn.settings, cut))


def _outcome(run: Run, settings: Settings, cut: str) -> tuple[Outcome, str]:
    """What a run counts as, and why."""
    wrong = (
        (f"the controller failed: {run.failed}" if run.failed else "")
        or ("its safety value is below the threshold" if run.below else "")
        or (f"the gate closed: {run.closed}" if run.closed else "")
    )
    if run.from_start is False:
        if wrong and (run.failed or run.took_over):
            return "censored", f"not driven from its start, and {wrong}"
        return "left_out", "not driven from its start"
    if run.failed or run.below:
        return "unsafe", wrong
    if run.closed:
        return "censored" if run.closed in CENSORED else settings.gate_closing, wrong
    return ("censored", cut) if cut else ("safe", "the scenario came to its end")


# ---------------------------------------------------------------- counts and limits


def _count(turn: Turn, run: Run, outcome: Outcome, reason: str) -> None:
    """Adds a run to its two sequences. A lower limit above the profile's marks both (`refusal`)."""
    memory, settings = turn.memory, turn.settings
    limits = limits_of(memory, run.controller, run.certificate)
    if outcome != "left_out":
        sequences, whole, own = _sequences(memory, settings, run.controller, run.certificate)
        whole, own = _with(whole, outcome), _with(own, outcome)
        limits = _limits(whole, own)
        if settings.max_unsafe > 0.0 and any(one.lower > settings.max_unsafe for one in limits):
            whole, own = msgspec.structs.replace(whole, exceeded=True), msgspec.structs.replace(own, exceeded=True)
        turn.remember_soon(runs=_kept(memory, whole, own), run_sequences=sequences)
    turn.emit(EpisodeCounted(turn.now, run.controller, run.certificate, run.index, run.steps, run.safety, outcome, reason, limits))


def _with(one: RunCounts, outcome: Outcome) -> RunCounts:
    return msgspec.structs.replace(
        one, n=one.n + 1, unsafe=one.unsafe + (outcome == "unsafe"), censored=one.censored + (outcome == "censored")
    )


def _sequences(memory: Memory, settings: Settings, controller: str, certificate: str) -> tuple[int, RunCounts, RunCounts]:
    """How many sequences there are, the controller's, and its certificate's; each begun if it is not there."""
    number, whole, own = memory.run_sequences, _find(memory, controller, ""), _find(memory, controller, certificate)
    if whole is None:
        number += 1
        whole = RunCounts(controller, "", number, share(settings.beta_episodes, number))
        return number, whole, msgspec.structs.replace(whole, certificate=certificate)
    if own is not None and own.number == whole.number and _counts(own) != _counts(whole):
        own = None  # another certificate's runs came between
    if own is None:
        number += 1
        own = RunCounts(controller, certificate, number, share(settings.beta_episodes, number))
    return number, whole, own


def share(beta: float, number: int) -> float:
    """What the number-th (1, 2, ...) sequence of a robot spends of the budget beta: 6 beta / (pi^2 i^2), in all beta."""
    return 2.0 * ledger.share(beta, number)


def _kept(memory: Memory, whole: RunCounts, own: RunCounts) -> tuple[RunCounts, ...]:
    """What is remembered: certificates in force, and the newest controllers."""
    valid = {facts.id for facts in memory.certificates}
    before = [one for one in memory.runs if one.controller != own.controller or one.certificate not in ("", own.certificate)]
    kept = [one for one in before if not one.certificate or one.certificate in valid]
    while sum(not one.certificate for one in kept) >= CONTROLLERS:
        oldest = min((one for one in kept if not one.certificate), key=lambda one: one.exceeded)
        kept = [one for one in kept if one.controller != oldest.controller]
    return (*kept, whole, own)


def _find(memory: Memory, controller: str, certificate: str) -> RunCounts | None:
    return next((one for one in memory.runs if (one.controller, one.certificate) == (controller, certificate)), None)


def _counts(one: RunCounts) -> anytime.Counts:
    return anytime.Counts(one.n, one.unsafe, one.censored)


def _limits(*sequences: RunCounts) -> tuple[RunLimits, ...]:
    """The limits of each sequence; the same event is computed once."""
    found: list[RunLimits] = []
    for one in sequences:
        if found and (found[0].number, found[0].n) == (one.number, one.n):
            found.append(msgspec.structs.replace(found[0], certificate=one.certificate))
            continue
        lower_share, upper_share = LOWER_SHARE * one.beta, (1.0 - LOWER_SHARE) * one.beta
        lower, upper = anytime.limits(_counts(one), lower_share, upper_share)
        counts = one.n, one.unsafe, one.censored
        found.append(RunLimits(one.certificate, one.number, *counts, lower, upper, lower_share, upper_share))
    return tuple(found)


def limits_of(memory: Memory, controller: str, certificate: str = "") -> tuple[RunLimits, ...]:
    """Of a controller's runs, and of those under that certificate; nothing where none was counted."""
    both = (_find(memory, controller, ""), _find(memory, controller, certificate) if certificate else None)
    return _limits(*(one for one in both if one is not None))


# ---------------------------------------------------------------- what rests on them


def refusal(memory: Memory, settings: Settings, controller: str) -> str:
    """Why this controller may not drive, or empty: too many of its runs were unsafe."""
    whole = _find(memory, controller, "")
    if whole is None or not whole.exceeded or settings.max_unsafe <= 0.0:
        return ""
    (limits,) = _limits(whole)
    return (
        f"{REASON}: of {whole.n} runs of this controller on this robot {whole.unsafe} were unsafe, at least {limits.lower:.3g} by the "
        f"lower limit now, and guarantee.max_unsafe is {settings.max_unsafe:g}. If the cause was removed: s2r clear {REASON}"
    )


def clear(turn: Turn, request_id: int) -> None:
    """A person removed the cause: runs of controllers that exceeded the limit are discarded, and later ones get a new share."""
    exceeded = {one.controller for one in turn.memory.runs if one.exceeded}
    if not exceeded:
        turn.answer(request_id, 2, f"{REASON} is not latched: no controller's runs exceeded guarantee.max_unsafe")
        return
    turn.remember(runs=tuple(one for one in turn.memory.runs if one.controller not in exceeded), runs_cleared=turn.memory.runs_cleared + 1)
    turn.persist()
    turn.answer(request_id, 0, f"the runs of {len(exceeded)} controllers are discarded; their next run begins a new sequence")


def status(memory: Memory, settings: Settings | None, controller: str, certificate: str) -> dict[str, object] | None:
    """Of the controller that is deployed, else of the one that drove last: its runs, and those under the certificate in force."""
    if settings is None or not counted(settings):
        return None
    if not controller and memory.runs:
        controller = memory.runs[-1].controller
    limits = [msgspec.structs.asdict(one) for one in limits_of(memory, controller, certificate)]
    whole = next((one for one in limits if not one["certificate"]), None)
    own = next((one for one in limits if one["certificate"]), None)
    return {
        "controller": controller or None,
        "all": whole,
        "under_certificate": own,
        "max_unsafe": settings.max_unsafe or None,
        "refused": bool(refusal(memory, settings, controller)),
    }
