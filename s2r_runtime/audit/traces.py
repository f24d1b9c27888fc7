"""Traces another time: the rows out of this log, the same tracer, the same seed; and who put the repaired model in force (guarantee G6).

What a trace says of itself is compared with what the log holds: the stretch and its records, the model, the seed, the options, and that the
model that it made is the one that is attached and remembers what it was fitted on. Then it is run again, in a worker, and must come out

    the same machine (versions, platform, processor)   identical
    another one                                        the same verdict and effects, every number within 1e-6
    another version of the tracer                      its rows are checked, its answer is not recomputed; that is said, and is no pass

A trace that takes longer than `seconds` of the processor is not run again unless that was asked for; that is said, and is no pass. No
sample of a repaired model's gap may be a transition of the rows that it was fitted on.
"""

from __future__ import annotations

import math
import time
from bisect import bisect_left
from typing import TYPE_CHECKING, Any, NamedTuple

import msgspec

from s2r_runtime.audit.findings import Findings, ModelFinding
from s2r_runtime.daemon.trace_job import VOLATILE, options
from s2r_runtime.daemon.worker import Failed, Progress, Result, TraceJob, Worker
from s2r_runtime.errors import ConfigError
from s2r_runtime.messages import JobFinished, Memory, ModelAdopted, SampleTaken, StartCampaign, StartJob, Struct
from s2r_runtime.modelspec import COMPACT, form_of, parse_model
from s2r_runtime.recording.layout import Attached
from s2r_runtime.recording.reading import Entry
from s2r_runtime.recording.stretches import CHANNELS, Cut, Stretches, log_identity
from s2r_runtime.trace import VERSION

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping, Sequence

    from s2r_runtime.modelspec import ModelSpec
    from s2r_runtime.profile import Profile

ELSEWHERE = 1e-6
"""How far a number of a trace may be off on another machine: a fit takes many steps of arithmetic that differ in their last digits."""
FIRST = 1
"""Version of the tracer of an answer that states none."""
SECONDS = 60.0
"""Of the processor, for one trace, if nothing else was asked for."""
PATIENCE = 20.0
"""Times that, by the clock, on a busy machine."""
POLL_S = 0.02
RELEVANT = frozenset(CHANNELS)


class _Ordered(NamedTuple):
    """A trace that was ordered, and what there was to trace then. whole: whether these logs hold all of it."""

    order: StartJob
    cut: Cut | None
    whole: bool


class _Made(NamedTuple):
    """A model that a trace made. how: how far that was checked. stamps, rows: what it was fitted on, by the robot's stamp."""

    what: str
    how: str
    proposed: bool
    stamps: tuple[int, ...]
    rows: dict[int, tuple[float, ...]]


class Traces:
    """Of all runs. seconds: of the processor that running one again may take; None: as long as it takes."""

    def __init__(self, findings: Findings, *, seconds: float | None, progress: Callable[[str], None]) -> None:
        self._findings, self._seconds, self._progress = findings, seconds, progress
        self._stretches = Stretches(1)
        self._orders: dict[int, _Ordered] = {}
        self._made: dict[str, _Made] = {}
        self._keys: dict[str, bytes] = {}
        self._begun: set[int] = set()
        self._samples: set[tuple[int, int]] = set()
        self._remembered = ""

    # ---- what the log holds

    def begin_run(self, run: str, public_key: bytes, rows: int, memory: Memory) -> None:
        """A run begins. rows: as many observations as a trace is made on at most."""
        self._keys[run] = public_key
        self._stretches.begin_run(run, rows)
        self._orders.clear()
        self._remembered = "" if memory.proposal is None else memory.proposal.digest

    def take(self, entry: Entry, message: Struct) -> None:
        """The next message, in the log's order. (Only those of RELEVANT channels matter.)"""
        if isinstance(message, StartCampaign) and not message.resume:
            self._begun.add(message.epoch)
        elif isinstance(message, SampleTaken):
            if message.again and (message.epoch, message.index) not in self._samples:
                self._begun.discard(message.epoch)  # there is a log between that was not given
            self._samples.add((message.epoch, message.index))
        elif isinstance(message, StartJob) and message.kind == "trace" and message.stretch:
            whole = message.stretch != "campaign" or message.epoch in self._begun
            self._orders[message.job_id] = _Ordered(message, self._stretches.cut(message.stretch, message.epoch), whole)
        self._stretches.take(entry.index, message)

    # ---- what a trace says

    def finished(
        self,
        entry: Entry,
        event: JobFinished,
        profile: Profile,
        states: tuple[str, ...],
        attachments: Mapping[str, Attached],
        *,
        runnable: bool,
    ) -> None:
        """A trace ended. states: of the model. runnable: it can be computed here."""
        ordered = self._orders.pop(event.job_id, None)
        if event.error:
            self._findings.count("traces without a result (taken as recorded)")
            return
        if ordered is None or event.trace is None:
            return
        order, cut, whole = ordered
        name = f"trace {event.job_id} (the {order.stretch} of epoch {order.epoch})"
        if not whole:
            self._findings.lack(f"what {name} was made on, in an earlier log that was not given")
            self._note(event.trace, name, "it was not run again: what it was made on is in an earlier log", None)
            return
        told = _told(order, cut, profile, states)
        problem = _told_wrong(event.trace, told, profile) or _model_wrong(event.trace, profile, attachments)
        if problem or cut is None:
            self._findings.differ(entry.index, entry.channel, f"{name}: {problem}", _facts(event.trace), told)
            return
        self._findings.count("traces checked against their rows")
        version = event.trace.get("tracer", FIRST)
        if version != VERSION:
            by = f"by another tracer (version {version}, here {VERSION})"
            self._findings.skip(f"{name} was made {by}: its rows were checked, its answer was not recomputed")
            self._note(event.trace, name, f"made {by}, it was not run again", cut)
            return
        how = self._again(entry, event.trace, order, cut, profile, name) if runnable else "it was not run again"
        if how:
            self._note(event.trace, name, how, cut)

    def _again(self, entry: Entry, trace: dict[str, Any], order: StartJob, cut: Cut, profile: Profile, name: str) -> str:
        """Runs it again; how that went, or nothing if it came out otherwise."""
        self._progress(name)
        identities = tuple(log_identity(part.run, self._keys.get(part.run, b"")) for part in cut.about.parts)
        job = TraceJob(
            profile,
            cut.about.stretch,
            order.epoch,
            order.rows,
            order.seed,
            cut=cut,
            identities=identities,
            cpu_s=self._seconds or 0.0,
            row_sketch=form_of(spec.fitted_on) if (spec := _spec(trace)) else COMPACT,
        )
        done = _work(
            job, math.inf if self._seconds is None else PATIENCE * self._seconds, lambda share: self._progress(f"{name}: {share:.0f} %")
        )
        if isinstance(done, Failed) or done.trace is None:
            why = done.text if isinstance(done, Failed) else "no result"
            if not why.startswith(("the worker died", "not done within")):
                self._findings.differ(entry.index, entry.channel, f"{name} gives no result now: {why}", _facts(trace), why)
                return ""
            if self._seconds is None:
                self._findings.cannot(f"{name}: {why}")
                return "it could not be run again"
            self._findings.skip(
                f"{name} was not run again: it takes more than {self._seconds:g} s of the processor; --rerun-traces takes them"
            )
            return "it was not run again"
        problem = unlike(trace, done.trace, exact=self._findings.same_machine)
        if problem:
            self._findings.differ(entry.index, entry.channel, f"{name}: {problem}", _result(trace), _result(done.trace))
            return ""
        where = "" if self._findings.same_machine else " (other machine: within 1e-6)"
        self._findings.count(f"traces run again{where}")
        return "it was run again, and made it"

    def _note(self, trace: dict[str, Any], name: str, how: str, cut: Cut | None) -> None:
        """Remembers the model that it made."""
        spec, proposal = _spec(trace), trace.get("proposal")
        if spec is None or not isinstance(proposal, dict):
            return
        rows = {stamp: x for one in cut.segments for stamp, x in one.states} if cut is not None else {}
        self._made[spec.digest()] = _Made(name, how, proposal.get("proposed") is True, tuple(sorted(rows)), rows)

    # ---- what became of the model

    def adopted(self, output: ModelAdopted) -> None:
        """A model comes into force: whose it is, and who decided."""
        made = self._made.get(output.digest)
        who = "the profile (repair.adopt)" if output.by < 0 else f"user {output.by}"
        if made is not None and made.proposed:
            origin = f"the one that {made.what} proposes; {made.how}"
        elif made is not None:
            origin = f"made by {made.what}, which does not propose it; {made.how}"
        elif output.proposed and output.digest == self._remembered:
            origin = "proposed by a trace in an earlier log that was not given"
            self._findings.lack(f"the trace that proposed model {output.digest}, in an earlier log that was not given")
        else:
            origin = "a person's own file: no trace in these logs made it"
        self._findings.models.append(ModelFinding(output.digest, who, origin))

    def seen_by_the_fit(self, spec: ModelSpec, samples: Sequence[SampleTaken], dt_ns: int) -> str:
        """Why this model's gap may not rest on these samples (guarantee G6), or empty."""
        made = self._made.get(spec.digest())
        if made is None:
            return ""
        for sample in samples:
            if made.rows.get(sample.t0_ns) != sample.x0:
                continue
            next_one = bisect_left(made.stamps, sample.t0_ns + dt_ns - dt_ns // 5)
            if next_one < len(made.stamps) and made.rows[made.stamps[next_one]] == sample.x1:
                return f"sample {sample.index} is a transition that its model was fitted on, by {made.what} (guarantee G6)"
        return ""


# ---------------------------------------------------------------- what it says of itself


def _told(order: StartJob, cut: Cut | None, profile: Profile, states: tuple[str, ...]) -> dict[str, Any]:
    """What a trace of this order must say it was made with."""
    return {
        "recording": None if cut is None else msgspec.json.decode(msgspec.json.encode(cut.about)),
        "model": order.digest,
        "seed": order.seed,
        "options": options(profile, states, order.rows),
    }


def _facts(trace: dict[str, Any]) -> dict[str, Any]:
    return {key: trace.get(key) for key in ("recording", "model", "seed", "options")}


def _result(trace: dict[str, Any]) -> dict[str, Any]:
    return {key: trace.get(key) for key in ("verdict", "effects", "depends_on", "proposal")}


def _told_wrong(trace: dict[str, Any], told: dict[str, Any], profile: Profile) -> str:
    """What in a trace's account of itself is not so, or empty."""
    if told["recording"] is None:
        return "there was nothing to trace"
    if trace.get("recording") != told["recording"]:
        return "it was not made on what the log holds"
    if trace.get("model") != told["model"] or told["model"] != profile.model.digest():
        return "it is of another model than the one in force"
    if type(trace.get("tracer", FIRST)) is not int:
        return "it does not say which tracer made it"
    if trace.get("seed") != told["seed"] or trace.get("options") != told["options"]:
        return "it had another seed, or other options, than it was ordered with"
    return ""


def _model_wrong(trace: dict[str, Any], profile: Profile, attachments: Mapping[str, Attached]) -> str:
    """What is wrong with the model that it says it made, or empty."""
    spec, proposal, recording = _spec(trace), trace.get("proposal"), trace.get("recording")
    if spec is None or not isinstance(proposal, dict) or not isinstance(recording, dict):
        return "it does not say which model it made"
    if spec.digest() != proposal.get("digest"):
        return "the model that it proposes is not the one that it made"
    if spec.effects == profile.model.effects:
        return "it proposes the model that it began with" if proposal.get("proposed") else ""
    if recording.get("digest") not in spec.fitted_on:
        return "the model that it made does not say that it was fitted on these rows (guarantee G6)"
    attached = attachments.get(f"model/{spec.digest()}")
    if attached is None:
        return "the model that it made is not attached"
    try:
        same = parse_model(attached.data.decode(), ".", "attached")
    except (ConfigError, UnicodeDecodeError):
        return "the model that is attached for it cannot be read"
    if same.digest() != spec.digest():
        return "the model that is attached for it is another one"
    if not set(spec.fitted_on) <= set(same.fitted_on):
        return "the model that is attached for it does not say what it was fitted on (guarantee G6)"
    return ""


def _spec(trace: dict[str, Any]) -> ModelSpec | None:
    text = trace.get("model_toml")
    if not isinstance(text, str):
        return None
    try:
        return parse_model(text, ".", "model_toml")
    except ConfigError:
        return None


# ---------------------------------------------------------------- run again


def unlike(recorded: dict[str, Any], again: dict[str, Any], *, exact: bool) -> str:
    """In what two traces differ that must not, or empty. exact: every value; else verdict and effects, numbers within ELSEWHERE."""
    for key in ("verdict", "effects", "ambiguous_with", "depends_on"):
        one, other = recorded.get(key), again.get(key)
        if not (one == other if exact else near(one, other)):
            return f"it ends with {'another verdict' if key == 'verdict' else f'other {key}'} when it is run again"
    if exact:
        for key in sorted((recorded.keys() | again.keys()) - {*VOLATILE, "tracer"}):  # of one version, stated or not
            if recorded.get(key) != again.get(key):
                return f"it ends with another {key} when it is run again"
        return ""
    one, other = _spec(recorded), _spec(again)
    alike = one is not None and other is not None and near(*(msgspec.to_builtins(spec.effects) for spec in (one, other)))
    proposed = [(trace.get("proposal") or {}).get("proposed") for trace in (recorded, again)]
    return "" if alike and proposed[0] == proposed[1] else "it makes another model when it is run again"


def near(a: Any, b: Any) -> bool:
    """Equal, but for numbers that are within ELSEWHERE of each other, relative. a, b: plain data."""
    if isinstance(a, bool) or isinstance(b, bool):
        return a is b
    if isinstance(a, int | float) and isinstance(b, int | float):
        return a == b or math.isclose(a, b, rel_tol=ELSEWHERE, abs_tol=1e-12)
    if isinstance(a, dict) and isinstance(b, dict):
        return a.keys() == b.keys() and all(near(value, b[key]) for key, value in a.items())
    if isinstance(a, list | tuple) and isinstance(b, list | tuple):
        return len(a) == len(b) and all(map(near, a, b))
    return bool(a == b)


def _work(job: TraceJob, timeout_s: float, progress: Callable[[float], None]) -> Result | Failed:
    """Does the job in a worker process."""
    worker = Worker(job, timeout_s if math.isfinite(timeout_s) else 1e8)
    try:
        while True:
            for message in worker.poll(time.monotonic_ns()):
                if not isinstance(message, Progress):
                    return message
                progress(100.0 * message.done / max(message.total, 1.0))
            time.sleep(POLL_S)
    finally:
        worker.stop()
