"""Computes gaps and verifications again, and holds every certificate against what the log shows (DESIGN G1, G2, G4)."""

from __future__ import annotations

import time
from typing import TYPE_CHECKING

import msgspec

from s2r_runtime import certificate as certificates
from s2r_runtime import jobs, keys, ledger
from s2r_runtime.audit_findings import CertificateFinding, Findings, alike
from s2r_runtime.canonical import digest_of
from s2r_runtime.controller_file import ControllerFile
from s2r_runtime.errors import ConfigError, S2RError
from s2r_runtime.layout import Attached
from s2r_runtime.messages import (
    AttemptSpent,
    CertificateStored,
    EpochChanged,
    Gap,
    IssueCertificate,
    JobFinished,
    Memory,
    Revoked,
    SampleTaken,
    Settings,
    StartJob,
    Verification,
)
from s2r_runtime.profile import Profile
from s2r_runtime.reading import Entry
from s2r_runtime.worker import Failed, GapJob, Progress, Result, VerifyJob, Worker

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping, Sequence

POLL_S = 0.05


class Evidence:
    """Of all runs. rerun: whether attached controllers may run, confined."""

    def __init__(self, findings: Findings, *, rerun: bool, progress: Callable[[str], None]) -> None:
        self._findings, self._rerun, self._progress = findings, rerun, progress
        self._jobs: dict[int, tuple[StartJob, Gap | None]] = {}
        self._gaps: dict[str, str] = {}
        self._verifications: dict[str, str] = {}
        self._orders: dict[int, tuple[IssueCertificate, bool]] = {}
        self._epochs = self._attempts = 0

    # ---- what is spent

    def begin_run(self, entry: Entry, memory: Memory) -> None:
        """A run begins with this memory: it may not forget what an earlier run spent."""
        self._jobs.clear()
        self._orders.clear()
        if memory.epochs < self._epochs or memory.attempts < self._attempts:
            told = {"epochs": self._epochs, "attempts": self._attempts}
            found = {"epochs": memory.epochs, "attempts": memory.attempts}
            self._findings.differ(
                entry.index, entry.channel, "the memory forgets epochs or attempts that an earlier log spent", found, told
            )
        self._epochs, self._attempts = memory.epochs, memory.attempts

    def spent(self, entry: Entry, output: EpochChanged | AttemptSpent, beta: float) -> None:
        """An epoch or attempt is begun: the next one, at its share of the budget."""
        if isinstance(output, AttemptSpent):
            number, due = output.attempt, self._attempts + 1
            self._attempts = max(number, self._attempts)
        elif output.gap is None:
            number, due = output.epoch, self._epochs + 1
            self._epochs = max(number, self._epochs)
        else:
            return
        if number < due or output.beta != ledger.share(beta, number):
            self._findings.differ(entry.index, entry.channel, "the budget is not spent in order", output, [due, ledger.share(beta, due)])
        self._findings.count("shares of the budget")

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
        elif event.trace is not None:
            self._findings.count("traces (not recomputed)")

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
        controller = _controller(attachments, job.digest)
        if controller is None or gap is None:
            self._findings.cannot(f"verification attempt {job.attempt}: the controller is not attached")
            return
        self._progress(f"verification attempt {job.attempt}")
        order = VerifyJob(profile, controller, gap, job.radius, job.hold_radius, job.attempt, job.seed, job.beta)
        again = _work(order, profile.verification.timeout, self._progress)
        if isinstance(again, Failed) or again.verification is None:
            self._findings.cannot(f"verification attempt {job.attempt}: {again.text if isinstance(again, Failed) else 'no result'}")
        elif alike(again.verification, found) and again.safety == event.safety:
            self._findings.count("verifications run again")
        elif not self._findings.same_platform and _verdicts(again.verification) == _verdicts(found):
            self._findings.count("verifications run again (other platform: same verdicts)")
        else:
            self._differ(entry, f"verification attempt {job.attempt} ends otherwise", found, again.verification)
            self._verifications[key] = "its verification ends otherwise when it is run again"

    # ---- certificates

    def issuing(self, order: IssueCertificate, *, traced: bool) -> None:
        """The core has a certificate signed."""
        self._orders[order.request_id] = (order, traced)

    def stored(
        self,
        entry: Entry,
        event: CertificateStored,
        profile: Profile,
        settings: Settings,
        horizon: Callable[[], int],
        attachments: Mapping[str, Attached],
        trusted: tuple[bytes, ...],
    ) -> None:
        """A certificate is in force. trusted: keys whose signature counts; the log's own first."""
        identity = event.facts.id
        try:
            note = self._judged(event, profile, settings, horizon, attachments, trusted)
            valid = True
        except ConfigError as error:
            note, valid = str(error), False
        self._findings.certificates[identity] = CertificateFinding(identity, valid, note)
        if not valid:
            self._differ(entry, f"certificate {identity}: {note}", event.facts, None)

    def revoked(self, output: Revoked) -> None:
        """It was withdrawn; what it said when it was issued stays as true as it was."""
        finding = self._findings.certificates.get(output.certificate_id)
        if finding is not None:
            finding.reason += f"; revoked later: {output.reason}"

    def _judged(
        self,
        event: CertificateStored,
        profile: Profile,
        settings: Settings,
        horizon: Callable[[], int],
        attachments: Mapping[str, Attached],
        trusted: tuple[bytes, ...],
    ) -> str:
        """Why it stands. Raises ConfigError with why it doesn't."""
        data = attachments.get(f"certificate/{event.facts.id}")
        if data is None:
            raise ConfigError("is not attached to the log")
        elsewhere = event.gap is not None
        signer = _signer(data.data)
        certificate = certificates.load(data.data, {*trusted, signer} if elsewhere else trusted[:1], None, "certificate")
        if certificates.facts(certificate) != event.facts:
            raise ConfigError("what the gate was told is not what it says")
        if elsewhere:
            known = "a trusted key" if signer in trusted else f"key {keys.fingerprint(signer)}, not compared with a trusted one"
            return f"signed elsewhere by {known}; its evidence is not in this log"
        order, traced = self._orders.get(event.request_id, (None, False))
        if order is None:
            raise ConfigError("nobody asked for it")
        for problem in (self._gaps.get(digest_of(order.gap)), self._verifications.get(digest_of(order.verification))):
            if problem:
                raise ConfigError(problem)
        controller = _controller(attachments, certificate.controller_digest)
        if controller is None:
            raise ConfigError("the controller that it is of is not attached")
        if certificate.profile_digest != settings.profile_digest:
            raise ConfigError("it is of another profile")
        again = certificates.issue(
            profile=profile,
            controller=controller,
            gap=order.gap,
            verification=order.verification,
            issued_unix_s=certificate.issued_unix_s,
            lifetime_s=order.lifetime_s,
            horizon=horizon(),
            traced_not_adopted=traced,
        )
        if again.id != certificate.id:
            raise ConfigError("what it says is not what the evidence says")
        self._findings.count("certificates")
        return self._support(order)

    def _support(self, order: IssueCertificate) -> str:
        gap, verification = digest_of(order.gap), digest_of(order.verification)
        told = "its gap was computed again" if gap in self._gaps else "its gap is from an earlier log"
        ran = (
            "and its verification run again"
            if self._rerun and verification in self._verifications
            else "its verification was not run again"
        )
        return f"{told}, {ran}"

    def _differ(self, entry: Entry, what: str, recorded: object, recomputed: object) -> None:
        self._findings.differ(entry.index, entry.channel, what, recorded, recomputed)


def _contradiction(v: Verification, job: StartJob, safety: dict[str, list[float]], profile: Profile) -> str:
    """What in a verification contradicts its order or its scenarios' safety values, or empty."""
    if (v.attempt, v.seed, v.radius, v.hold_radius) != (job.attempt, job.seed, job.radius, job.hold_radius):
        return "the verification is not the one that was ordered"
    if v.threshold != profile.verification.threshold or v.epsilon != profile.verification.epsilon:
        return "the verification has another threshold or epsilon than the profile"
    for law in v.laws:
        values = safety.get(law.law)
        if values is None:
            continue
        failures = sum(value < v.threshold for value in values)
        if (len(values), min(values, default=0.0), failures) != (law.n, law.s_star, law.failures):
            return f"the numbers of the law {law.law} are not those of its scenarios"
        if law.passed != (law.s_star >= v.threshold and law.progress_ok):
            return f"the verdict of the law {law.law} is not that of its numbers"
    return ""


def _verdicts(v: Verification) -> list[object]:
    return [v.passed, *((law.law, law.passed, law.progress_ok) for law in v.laws)]


def _controller(attachments: Mapping[str, Attached], digest: str) -> ControllerFile | None:
    """The attached controller of that digest. None if there is none, or what is there has another digest."""
    attached = attachments.get(f"controller/{digest}")
    if attached is None:
        return None
    try:
        file = msgspec.json.decode(attached.data, type=ControllerFile)
    except msgspec.DecodeError:
        return None
    return file if file.digest == digest else None


def _signer(data: bytes) -> bytes:
    """The public key that stands in a certificate's file; empty if there is none to be seen."""

    class Key(msgspec.Struct):
        public_key: bytes = b""

    try:
        return msgspec.json.decode(data, type=Key).public_key
    except (msgspec.DecodeError, UnicodeDecodeError):
        return b""


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
