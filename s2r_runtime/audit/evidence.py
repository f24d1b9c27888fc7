"""Computes gaps and verifications again, and holds every certificate against what the log shows (guarantee G1, G2, G4)."""

from __future__ import annotations

import time
from typing import TYPE_CHECKING

import msgspec

from s2r_runtime.audit.findings import Findings, alike, close
from s2r_runtime.audit.traces import Traces
from s2r_runtime.controllers.file import ControllerFile
from s2r_runtime.core import ledger
from s2r_runtime.core.headroom import follows, grid
from s2r_runtime.daemon import jobs
from s2r_runtime.daemon.past import lost
from s2r_runtime.daemon.worker import Failed, GapJob, Progress, Result, VerifyJob, Worker
from s2r_runtime.errors import S2RError
from s2r_runtime.evidence.bounds import clopper_pearson_upper
from s2r_runtime.files.canonical import digest_of
from s2r_runtime.messages import (
    FIXED_SEEDS,
    AttemptSpent,
    DrawSeed,
    EpochChanged,
    Gap,
    IssueCertificate,
    JobFinished,
    LawResult,
    Memory,
    SampleTaken,
    SeedDrawn,
    Settings,
    StartJob,
    Verification,
)
from s2r_runtime.profile import Profile
from s2r_runtime.recording.layout import Attached
from s2r_runtime.recording.reading import Entry

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping, Sequence

POLL_S = 0.05
ROUNDED = 1e-6
"""Safety values in the log are rounded to fewer digits than the verdicts were made of."""


class Evidence:
    """Of all runs. rerun: whether attached controllers may run, confined."""

    def __init__(self, findings: Findings, traces: Traces, *, rerun: bool, progress: Callable[[str], None]) -> None:
        self._findings, self._traces, self._rerun, self._progress = findings, traces, rerun, progress
        self._jobs: dict[int, tuple[StartJob, Gap | None]] = {}
        self._gaps: dict[str, str] = {}
        self._verifications: dict[str, str] = {}
        self._in_force: dict[int, Gap] = {}
        self._epochs = self._attempts = 0
        self._undrawn: set[tuple[int, int]] = set()
        self._seeds: dict[int, int] = {}
        self._kept: Memory | None = None
        self._saving: Memory | None = None

    # ---- what lasts, and what is spent

    def persisted(self, memory: Memory) -> None:
        """This is saved, and what a later run may not forget; as soon as another event shows that the daemon got that far."""
        self._saving = memory

    def settled(self) -> None:
        """An event is recorded."""
        self._kept, self._saving = self._saving or self._kept, None

    def doubted(self) -> None:
        """The disk did not take the log or the state: what the log says was kept may not have been."""
        self._kept = self._saving = None

    def begin_run(self, entry: Entry, memory: Memory) -> None:
        """A run begins with this memory: it may not forget what an earlier run spent."""
        self._jobs.clear()
        self._undrawn.clear()
        before = self._kept if self._kept is not None and self._kept.robot == memory.robot else None
        if memory.epochs < self._epochs or memory.attempts < self._attempts:
            told = {"epochs": self._epochs, "attempts": self._attempts}
            found = {"epochs": memory.epochs, "attempts": memory.attempts}
            self._findings.differ(
                entry.index, entry.channel, "the memory forgets epochs or attempts that an earlier log spent", found, told
            )
        elif before is not None and (what := lost(before, memory) or _more(before, memory)):
            self._findings.differ(entry.index, entry.channel, f"the memory forgets {what}", memory, before)
        elif self._kept is not None and (cleared := set(self._kept.latched) - set(memory.latched)):
            self._findings.lack(f"who cleared {', '.join(sorted(cleared))}, in a log between two of those that were given")
        self._epochs, self._attempts, self._kept = memory.epochs, memory.attempts, memory
        gap = memory.gap
        if gap is None:
            return
        known = self._in_force.get(gap.epoch)
        if known is None:
            self._findings.lack(f"what the gap of epoch {gap.epoch} was computed from, in an earlier log that was not given")
        elif known != gap:
            self._findings.differ(entry.index, entry.channel, f"the memory has another gap of epoch {gap.epoch}", gap, known)

    def spent(self, entry: Entry, output: EpochChanged | AttemptSpent, beta: float) -> None:
        """An epoch or attempt is begun: the next one, at its share of the budget."""
        if isinstance(output, AttemptSpent):
            number, due = output.attempt, self._attempts + 1
            self._attempts = max(number, self._attempts)
        elif output.gap is not None:
            self._in_force[output.epoch] = output.gap
            return
        else:
            number, due = output.epoch, self._epochs + 1
            self._epochs = max(number, self._epochs)
        if number < due or output.beta != ledger.share(beta, number):
            self._findings.differ(entry.index, entry.channel, "the budget is not spent in order", output, [due, ledger.share(beta, due)])
        self._findings.count("shares of the budget")

    def paid(self, order: DrawSeed) -> None:
        """An attempt is paid for, and its seed is to be drawn."""
        self._undrawn.add((order.job_id, order.attempt))

    def seed_drawn(self, entry: Entry, event: SeedDrawn, settings: Settings | None) -> None:
        """Once for each attempt, after it was paid for; fixed in a simulation only. What is drawn from 2^48 does not come twice."""
        if (event.job_id, event.attempt) not in self._undrawn:
            self._differ(entry, "a seed is drawn for an attempt that waits for none", event, None)
        elif (other := self._seeds.setdefault(event.seed, event.attempt)) != event.attempt:
            self._differ(entry, f"attempt {event.attempt} has the seed of attempt {other}", event, None)
        elif settings is not None and settings.rules >= FIXED_SEEDS and event.fixed != settings.simulated:
            self._differ(entry, "a simulation fixes its seeds, and nothing else does", event, settings.simulated)
        self._undrawn.discard((event.job_id, event.attempt))
        self._findings.count("seeds fixed by a simulation" if event.fixed else "seeds drawn after their attempt was paid for")

    # ---- what is computed

    def ordered(self, job: StartJob, gap: Gap | None) -> None:
        """The worker is told to do this. gap: the one in force."""
        self._jobs[job.job_id] = (job, gap)

    def finished(
        self,
        entry: Entry,
        event: JobFinished,
        profile: Profile,
        samples: Mapping[int, Sequence[SampleTaken]],
        rejected: Mapping[int, dict[str, int]],
        attachments: Mapping[str, Attached],
    ) -> None:
        """A result: it must follow from what was recorded before. profile: with the model in force."""
        job, gap = self._jobs.pop(event.job_id, (None, None))
        if job is None or event.error:
            return
        if event.gap is not None:
            self._gap(entry, event.gap, job, profile, samples.get(job.epoch, ()), rejected.get(job.epoch, {}))
        elif event.verification is not None:
            self._verification(entry, event, event.verification, job, gap, profile, attachments)

    def _gap(
        self, entry: Entry, gap: Gap, job: StartJob, profile: Profile, samples: Sequence[SampleTaken], rejected: dict[str, int]
    ) -> None:
        self._gaps[digest_of(gap)] = ""
        if len(samples) != gap.n:
            told = f"gap of epoch {job.epoch}: {len(samples)} of its {gap.n} samples are in the logs given"
            self._findings.cannot(told)
            self._gaps[digest_of(gap)] = told
            return
        try:
            again = jobs.gap(GapJob(profile, tuple(samples), rejected, job.epoch, job.beta))
        except S2RError as error:
            self._differ(entry, f"the gap of epoch {job.epoch} cannot be computed: {error}", gap, None)
            self._gaps[digest_of(gap)] = "its gap does not follow from the samples"
            return
        if problem := self._traces.seen_by_the_fit(profile.model, samples, round(profile.model.dt * 1e9)):
            self._differ(entry, f"the gap of epoch {job.epoch}: {problem}", gap, None)
            self._gaps[digest_of(gap)] = problem
            return
        if not alike(again, gap):
            self._differ(entry, f"the gap of epoch {job.epoch} is another one", gap, again)
            self._gaps[digest_of(gap)] = "its gap is not that of the samples"
            return
        self._findings.count("gaps")

    def _verification(
        self,
        entry: Entry,
        event: JobFinished,
        found: Verification,
        job: StartJob,
        gap: Gap | None,
        profile: Profile,
        attachments: Mapping[str, Attached],
    ) -> None:
        key = digest_of(found)
        self._verifications[key] = ""
        problem = _contradiction(found, job, event.safety, profile)
        if problem:
            self._differ(entry, problem, found, job)
            self._verifications[key] = problem
            return
        self._findings.count("verifications checked against their scenarios' values")
        if not self._rerun:
            self._findings.count("verifications not run again")
            return
        controller = attached_controller(attachments, job.digest)
        if controller is None or gap is None:
            self._findings.cannot(f"verification attempt {job.attempt}: the controller is not attached")
            return
        self._progress(f"verification attempt {job.attempt}")
        order = VerifyJob(profile, controller, gap, job.radius, job.hold_radius, job.attempt, job.seed, job.beta, job.least_radius)
        again = _work(order, profile.verification.timeout, self._progress)
        if isinstance(again, Failed) or again.verification is None:
            self._findings.cannot(f"verification attempt {job.attempt}: {again.text if isinstance(again, Failed) else 'no result'}")
        elif alike(again.verification, found) and (again.safety, again.behaviour) == (event.safety, event.behaviour or again.behaviour):
            self._findings.count("verifications run again")
        elif not self._findings.same_platform and _verdicts(again.verification) == _verdicts(found):
            self._findings.count("verifications run again (other platform: same verdicts)")
        else:
            self._differ(entry, f"verification attempt {job.attempt} ends otherwise", found, again.verification)
            self._verifications[key] = "its verification ends otherwise when it is run again"

    # ---- what rests on it

    def problem(self, order: IssueCertificate) -> str:
        """Why this evidence carries no certificate, or empty."""
        return self._gaps.get(digest_of(order.gap), "") or self._verifications.get(digest_of(order.verification), "")

    def support(self, order: IssueCertificate) -> str:
        """How far it was recomputed."""
        told = "its gap was computed again" if digest_of(order.gap) in self._gaps else "its gap is from an earlier log"
        ran = self._rerun and digest_of(order.verification) in self._verifications
        return f"{told}, its verification was {'' if ran else 'not '}run again"

    def _differ(self, entry: Entry, what: str, recorded: object, recomputed: object) -> None:
        self._findings.differ(entry.index, entry.channel, what, recorded, recomputed)


def _more(before: Memory, now: Memory) -> str:
    """Exceedances that no further discrepancy brought, or empty: what is left out then is what the watch made of the ones there were."""
    if before.gap is None or now.gap is None or before.gap.epoch != now.gap.epoch:
        return ""
    more = now.watch_n == before.watch_n and now.watch_exceedances > before.watch_exceedances
    return f"what the watch made of the {before.watch_n} discrepancies of epoch {now.gap.epoch}" if more else ""


def _contradiction(v: Verification, job: StartJob, safety: dict[str, list[float]], profile: Profile) -> str:
    """What in a verification contradicts its order, the profile, or its scenarios' safety values, or empty."""
    if (v.attempt, v.seed, v.beta) != (job.attempt, job.seed, job.beta):
        return "the verification is not the one that was ordered"
    if problem := _radii_problem(v, job):
        return problem
    wanted = profile.verification
    if (v.threshold, v.epsilon) != (wanted.threshold, wanted.epsilon):
        return "the verification has another threshold or epsilon than the profile"
    for law in v.laws:
        values = safety.get(law.law)
        if law.required != (law.law in wanted.required):
            return f"whether the law {law.law} is required is not what the profile says"
        if values is None or not _numbers_fit(law, values, v):
            return f"the numbers of the law {law.law} are not those of its scenarios"
        if law.passed != (law.s_star >= v.threshold and law.failures == 0 and law.progress_ok):
            return f"the verdict of the law {law.law} is not that of its numbers"
    passed = {law.law for law in v.laws if law.passed}
    if v.passed != (not v.reason) or (v.passed and not set(wanted.required) <= passed):
        return "the verdict is not that of the laws"
    return ""


def _radii_problem(v: Verification, job: StartJob) -> str:
    """What is wrong with the radii that were looked at, or empty: they are those of the order, in the order of the search, and the one
    reported is what the search ends with.
    """
    radii = grid(job.least_radius, job.radius)
    least = job.hold_radius * (v.radius / job.radius if job.radius > 0.0 else 1.0)
    if v.split != len(radii) or v.radius not in radii or not close(v.hold_radius, least):
        return "the verification is not at the radii that were ordered"
    if len(radii) == 1:
        return ""
    passed = [one.radius for one in v.tried if one.passed]
    if not follows(v.tried, len(radii)) or any(one.radius != radii[one.index] for one in v.tried):
        return "the radii that were looked at are not those of the search"
    return "" if v.radius == max(passed, default=radii[0]) else "the radius reported is not the largest that passed"


def _numbers_fit(law: LawResult, values: Sequence[float], v: Verification) -> bool:
    """values are logged rounded, so a failure may lie on either side of the threshold by that."""
    if len(values) != law.n or not values:
        return False
    surely, at_most = (sum(value < v.threshold + side for value in values) for side in (-ROUNDED, ROUNDED))
    upper = clopper_pearson_upper(law.failures, law.n, v.beta / v.split)
    return abs(min(values) - law.s_star) <= ROUNDED and surely <= law.failures <= at_most and close(law.failure_upper, upper)


def _verdicts(v: Verification) -> list[object]:
    return [v.passed, *((law.law, law.passed, law.progress_ok) for law in v.laws)]


def attached_controller(attachments: Mapping[str, Attached], digest: str) -> ControllerFile | None:
    """The attached controller of that digest. None if there is none, or what is there has another digest."""
    attached = attachments.get(f"controller/{digest}")
    if attached is None:
        return None
    try:
        file = msgspec.json.decode(attached.data, type=ControllerFile)
    except msgspec.DecodeError:
        return None
    return file if file.digest == digest else None


def _work(job: VerifyJob, timeout_s: float, progress: Callable[[str], None]) -> Result | Failed:
    """Does the job in a worker process."""
    worker = Worker(job, timeout_s)
    try:
        while True:
            for message in worker.poll(time.monotonic_ns()):
                if not isinstance(message, Progress):
                    return message
                progress(f"verification attempt {job.attempt}: {message.done:.0f} of {message.total:.0f}")
            time.sleep(POLL_S)
    finally:
        worker.stop()
