"""Verification attempts and certificates: what is spent, what is issued, installed, outgrown, revoked (guarantee G2, G4, G5, G8).

An attempt is persisted before it is begun, passed or not. A certificate is durable in the log before it is installed, and
installed and persisted before its controller starts. What the worker says is checked again here before it counts.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal, cast

import msgspec

from s2r_runtime import gate
from s2r_runtime.core import driven, ledger, runs
from s2r_runtime.core.drive import regate
from s2r_runtime.core.headroom import grid
from s2r_runtime.core.sources import end_deployment
from s2r_runtime.core.state import VERIFYING, Deployment, Job, Turn, certificate, job, situation, usable_gap
from s2r_runtime.messages import (
    BEHAVIOURS,
    FIXED_SEEDS,
    REFUSED_FIRST,
    SEEDS,
    AttemptEnded,
    AttemptSpent,
    CertificateFacts,
    CertificateFailed,
    CertificateInstalled,
    CertificatesDistrusted,
    CertificateStored,
    DrawSeed,
    EpisodeCounted,
    Gap,
    IssueCertificate,
    JobFinished,
    Revoked,
    SeedDrawn,
    StartController,
    StartJob,
    Tries,
    Verification,
)

Purpose = Literal["deploy", "verify", "reverify"]
ROUNDING = 1e-9
"""Relative; of values that went through another process's arithmetic."""


# ---------------------------------------------------------------- attempts


def refusal_to_verify(turn: Turn) -> str:
    """Why no attempt may be begun now, or empty. Asked before anything is spent."""
    gap = turn.memory.gap
    if gap is None:
        return "there is no gap yet; sample first: s2r sample"
    if usable_gap(turn.state) is None:
        return f"watch_alarm: the watch refuted the gap of epoch {gap.epoch}; sample anew: s2r sample"
    if job(turn.state, *VERIFYING) is not None:
        return "a verification is under way; wait for its end"
    if turn.settings.rules >= REFUSED_FIRST and (exceeded := driven.refusal(turn.memory, turn.settings)):
        return exceeded
    if boundless := _boundless(turn, gap):
        return boundless
    return _needs_more_laws(turn, gap, turn.settings.required_laws)


def begin_verification(
    turn: Turn,
    purpose: Purpose,
    digest: str,
    request_id: int,
    *,
    certificate_id: str = "",
    again: bool = False,
) -> None:
    """Spends an attempt, durably, and has the controller verified: at the grown radius at least, at up to `headroom` times that. There must
    be a gap, and not a boundless one.
    """
    memory, settings, gap = turn.memory, turn.settings, turn.memory.gap
    if gap is None:
        raise AssertionError("a verification without a gap")  # callers have asked refusal_to_verify
    attempt, (grown, radius, hold) = memory.attempts + 1, _radii(turn, gap)
    one = Job(turn.state.next_job, purpose, request_id, gap.epoch, digest, attempt, radius, hold, certificate_id, again, least_radius=grown)
    turn.add_job(one)
    turn.remember(attempts=attempt, gap_attempts=memory.gap_attempts + (settings.rules >= SEEDS))
    turn.persist()
    turn.emit(AttemptSpent(turn.now, attempt, ledger.share(settings.beta, attempt), digest, radius))
    if settings.rules >= SEEDS:
        turn.emit(DrawSeed(turn.now, one.id, attempt))
    else:  # as it was: a seed that whoever knows the digests knows beforehand
        known = digest, memory.model_digest, settings.task_digest, settings.profile_digest, gap.transitions_digest, attempt
        _start(turn, one, ledger.seed("verification", *known))
    regate(turn)


def seed_drawn(turn: Turn, event: SeedDrawn) -> None:
    """The attempt's seed is there, and in the log: it begins. Only its first seed counts."""
    waiting = (one for one in turn.state.jobs if (one.id, one.attempt) == (event.job_id, event.attempt))
    one = next(waiting, None)
    if one is None or one.purpose not in VERIFYING or one.seed is not None or turn.settings.rules < SEEDS:
        return
    turn.drop_job(one)
    seeded = msgspec.structs.replace(one, seed=event.seed, fixed=event.fixed)
    turn.set(jobs=(*turn.state.jobs, seeded))
    _start(turn, seeded, event.seed)


def _start(turn: Turn, one: Job, seed: int) -> None:
    share = ledger.share(turn.settings.beta, one.attempt)
    radii = one.radius, one.hold_radius
    turn.emit(StartJob(turn.now, one.id, "verify", one.epoch, one.digest, *radii, one.attempt, seed, share, least_radius=one.least_radius))


def _radii(turn: Turn, gap: Gap) -> tuple[float, float, float]:
    """The grown radius, the most that an attempt is made at, and the hold gap that goes with that."""
    grown = max(turn.memory.radius, gap.radius)
    return grown, turn.settings.headroom * grown, turn.settings.headroom * grown_hold(gap, grown)


def _boundless(turn: Turn, gap: Gap) -> str:
    """Why the gap has grown too large for any attempt, or empty: what is no finite number can be neither verified nor recorded."""
    grown, *asked = _radii(turn, gap)
    if all(gate.finite(value) for value in asked):
        return ""
    return f"the gap has grown to {grown:.6g}, and what would have to be verified is no finite number; sample anew: s2r sample"


def grown_hold(gap: Gap, radius: float) -> float:
    """The hold gap when the gap has grown to radius: in proportion. From a gap of nothing, all that h periods can add up to."""
    if gap.radius > 0.0:
        return gap.hold_radius * radius / gap.radius
    return max(gap.hold_radius, gap.hold_periods * radius)


def reverify_if_due(turn: Turn) -> None:
    """Verifies the driving controller anew when the radius has left what its certificate covers, beside the closed gate."""
    deployment, facts = turn.state.deployment, certificate(turn.state)
    if deployment is None or deployment.stage != "running" or facts is None or job(turn.state, *VERIFYING) is not None:
        return
    gap = usable_gap(turn.state)
    if gap is None or turn.memory.radius <= facts.verified_radius:
        return
    if _boundless(turn, gap):
        revoke(turn, [facts.id], "verification_failed_at_grown_radius")
    else:
        begin_verification(turn, "reverify", deployment.digest, 0, certificate_id=facts.id)


def verification_finished(turn: Turn, done: Job, event: JobFinished) -> None:
    """An attempt ended: a certificate is asked for, or the request is refused, or the driving controller loses its own."""
    result = event.verification
    problem = event.error or ("the worker returned no verification" if result is None else _result_problem(turn, done, result))
    reason = problem or (result.reason if result is not None else "") or "every required law passed"
    turn.emit(AttemptEnded(turn.now, done.attempt, not problem, reason))
    gap = usable_gap(turn.state)
    if turn.settings.rules >= SEEDS and turn.memory.gap is not None and turn.memory.gap.epoch == done.epoch:
        behaviour = event.behaviour or done.digest
        others = (one for one in turn.memory.behaviours if one != behaviour)
        turn.remember(behaviours=(*others, behaviour)[-BEHAVIOURS:])
    if result is None or problem:
        _refuse(turn, done, f"verification attempt {done.attempt} at radius {_least(done):.6g} failed: {reason}")
    elif gap is None or gap.epoch != done.epoch:
        _refuse(turn, done, f"the gap of epoch {done.epoch} does not hold any more")
    elif lacking := _needs_more_laws(turn, gap, tuple(law.law for law in result.laws if law.required)):
        _refuse(turn, done, lacking)
    elif result.radius < turn.memory.radius:
        _outgrown(turn, done, gap, result.radius)
    else:
        turn.set(issuing=msgspec.structs.replace(done, least_radius=result.radius))
        lifetime_s = turn.settings.certificate_lifetime_s
        driven_runs = next(iter(runs.limits_of(turn.memory, done.digest)), None) if runs.counted(turn.settings) else None
        turn.emit(IssueCertificate(turn.now, gap, result, done.request_id, lifetime_s, _tries(turn, done), driven_runs))
    reverify_if_due(turn)


def _result_problem(turn: Turn, done: Job, v: Verification) -> str:
    """Why this result does not show that the controller passed what was asked (guarantee G2), or empty."""
    if (v.controller_digest, v.model_digest, v.task_digest) != (done.digest, turn.memory.model_digest, turn.settings.task_digest):
        return "the result is of another controller, model or task"
    if v.attempt != done.attempt:
        return f"the result is of attempt {v.attempt}"
    if turn.settings.rules >= SEEDS and v.seed != done.seed:
        return "the result is of another seed than the one that was drawn for it"
    least, share = _least(done), ledger.share(turn.settings.beta, done.attempt) * (1.0 + ROUNDING)
    hold = done.hold_radius * (least / done.radius if done.radius > 0.0 else 1.0)
    for value, asked in ((v.radius, least), (v.hold_radius, hold)):
        if not (gate.finite(value) and value >= asked * (1.0 - ROUNDING)):
            return f"it was verified at {value}, less than {asked}"
    required = [law for law in v.laws if law.required]
    if not set(turn.settings.required_laws) <= {law.law for law in required}:
        return "a required law was not run"
    failed = [law.law for law in required if not (law.passed and law.progress_ok and law.s_star >= v.threshold)]
    if failed or not required or not v.passed:
        return v.reason or (f"the law {failed[0]} did not pass" if failed else "it did not pass")
    if v.split != (radii := len(grid(least, done.radius))):
        return f"its beta is split among {v.split} radii, {radii} were fixed beforehand"
    if not 0.0 < v.epsilon < 1.0:
        return "its numbers make no sense"
    if any(ledger.binomial_tail(law.n, 0, v.epsilon) > share / v.split for law in required):
        return f"{min(law.n for law in required)} scenarios are too few for the share of attempt {done.attempt}"
    return ""


def _tries(turn: Turn, done: Job) -> Tries | None:
    """What was tried until this job, itself included."""
    if turn.settings.rules < SEEDS:
        return None
    return Tries(done.attempt, turn.memory.gap_attempts, len(turn.memory.behaviours), done.fixed)


def _least(done: Job) -> float:
    """The least radius that will do for this job."""
    return done.least_radius or done.radius


def _needs_more_laws(turn: Turn, gap: Gap, required: tuple[str, ...]) -> str:
    """guarantee G8: what `uniform` alone cannot carry, or empty."""
    if required != ("uniform",):
        return ""
    if not gap.white:
        return "the residual is not white: the law uniform alone carries no certificate, require persistent as well"
    if turn.memory.traced:
        return "an effect was traced and not adopted: the law uniform alone carries no certificate, adopt it or require persistent as well"
    return ""


def _outgrown(turn: Turn, done: Job, gap: Gap, verified: float) -> None:
    """It passed at a radius that the stream has left meanwhile. Once more, paying again; then that is that."""
    if not _wanted(turn, done):
        return
    if done.again:
        _refuse(
            turn,
            done,
            f"the radius grew to {turn.memory.radius:.6g} while attempt {done.attempt} verified {verified:.6g}, twice in a row",
        )
    elif boundless := _boundless(turn, gap):
        _refuse(turn, done, boundless)
    else:
        turn.answer(done.request_id, 0, f"the radius grew to {turn.memory.radius:.6g} meanwhile; verifying again", final=False)
        purpose = cast(Purpose, done.purpose)
        begin_verification(turn, purpose, done.digest, done.request_id, certificate_id=done.certificate_id, again=True)


def _refuse(turn: Turn, done: Job, why: str) -> None:
    """No certificate comes of this job."""
    if done.purpose == "reverify":
        revoke(turn, [done.certificate_id], "verification_failed_at_grown_radius")
    elif done.purpose == "verify":
        turn.answer(done.request_id, 1, f"refused: {why}")
    elif _wanted(turn, done):
        end_deployment(turn, "no_certificate", f"refused: {why}")


def _wanted(turn: Turn, done: Job) -> bool:
    """Whether whom the job was begun for still waits for it."""
    deployment = turn.state.deployment
    if done.purpose == "deploy":
        return deployment is not None and deployment.stage == "verifying" and deployment.request_id == done.request_id
    return done.purpose == "verify" or (deployment is not None and deployment.certificate_id == done.certificate_id)


# ---------------------------------------------------------------- certificates


def valid_certificate(turn: Turn, digest: str) -> CertificateFacts | None:
    """The newest certificate under which this controller could drive now."""
    now = situation(turn.state)
    for facts in reversed(turn.memory.certificates):
        if _of_simulation(turn, facts):
            continue
        seen = msgspec.structs.replace(now, certificate=facts, controller_digest=digest, revoked=facts.id in turn.memory.revoked)
        if usable_gap(turn.state) is not None and gate.about_certificate(turn.settings, seen) is None:
            return facts
    return None


def certificate_stored(turn: Turn, event: CertificateStored) -> None:
    """The certificate that was asked for is durable: it is installed, and who waited for it goes on."""
    done, facts = turn.state.issuing, event.facts
    if done is None or event.request_id != done.request_id:
        return
    turn.set(issuing=None)
    gap = usable_gap(turn.state)
    if gap is None or gap.epoch != done.epoch or turn.memory.model_digest != facts.model_digest:
        revoke(turn, [facts.id], "gap_void")
        _refuse(turn, done, f"the gap of epoch {done.epoch} does not hold any more")
    elif problem := facts_problem(turn, facts, done.digest, gap.epoch, _least(done)):
        _refuse(turn, done, f"the certificate is not the one that was asked for: {problem}")
    else:
        install(turn, facts)
        _go_on(turn, done, gap, facts)
    reverify_if_due(turn)


def certificate_failed(turn: Turn, event: CertificateFailed) -> None:
    """The certificate that was asked for could not be made."""
    done = turn.state.issuing
    if done is None or event.request_id != done.request_id:
        turn.answer(event.request_id, 1, f"certificate refused: {event.error}", final=False)
        return
    turn.set(issuing=None)
    _refuse(turn, done, f"the certificate could not be issued: {event.error}")
    reverify_if_due(turn)


def facts_problem(turn: Turn, facts: CertificateFacts, digest: str, epoch: int, radius: float) -> str:
    """Why these facts do not certify this controller here, on the gap of that epoch, to this radius, or empty."""
    if facts.id in turn.memory.revoked:
        return f"it was revoked: {turn.memory.revoked[facts.id]}"
    if _of_simulation(turn, facts):
        return "a simulation fixed its seed beforehand"
    if exceeded := runs.refusal(turn.memory, turn.settings, facts.controller_digest):
        return exceeded
    if any(other.id == facts.id and other != facts for other in turn.memory.certificates):
        return "another certificate in force has its id"
    for name, value, wanted in (
        ("controller", facts.controller_digest, digest),
        ("model", facts.model_digest, turn.memory.model_digest),
        ("task", facts.task_digest, turn.settings.task_digest),
        ("profile", facts.profile_digest, turn.settings.profile_digest),
        ("epoch", facts.epoch, epoch),
    ):
        if value != wanted:
            return f"its {name} is {value}, here it is {wanted}"
    if not (gate.finite(facts.verified_radius) and facts.verified_radius >= radius * (1.0 - ROUNDING)):
        return f"it is verified to {facts.verified_radius}, less than {radius}"
    return ""


def _of_simulation(turn: Turn, facts: CertificateFacts) -> bool:
    """Whether it certifies nothing here, since its seed could be known beforehand."""
    return turn.settings.rules >= FIXED_SEEDS and facts.fixed_seed and not turn.settings.simulated


def install(turn: Turn, facts: CertificateFacts) -> None:
    """In force from now on. It takes the place of the same controller's certificates that reach no farther."""

    def stays(old: CertificateFacts) -> bool:
        return old.controller_digest != facts.controller_digest or old.verified_radius > facts.verified_radius

    kept = tuple(old for old in turn.memory.certificates if stays(old) and old.id != facts.id)
    turn.remember(certificates=(*kept, facts), attempts=max(turn.memory.attempts, facts.attempt))
    deployment, driving = turn.state.deployment, certificate(turn.state)
    if deployment is not None and deployment.stage != "verifying" and deployment.digest == facts.controller_digest and driving is None:
        turn.set(deployment=msgspec.structs.replace(deployment, certificate_id=facts.id))
    turn.emit(CertificateInstalled(turn.now, facts))
    turn.persist()
    regate(turn)


def _go_on(turn: Turn, done: Job, gap: Gap, facts: CertificateFacts) -> None:
    text = f"certificate {facts.id}: verified to radius {facts.verified_radius:.6g}"
    deployment = turn.state.deployment
    if done.purpose != "deploy":
        turn.answer(done.request_id, 0, text)
    elif deployment is not None and _wanted(turn, done):
        if facts.verified_radius < turn.memory.radius:
            _outgrown(turn, done, gap, facts.verified_radius)
        else:
            turn.answer(done.request_id, 0, text, final=False)
            start_controller(turn, deployment, facts)


def start_controller(turn: Turn, deployment: Deployment, facts: CertificateFacts) -> None:
    """The deployment has its certificate: its process may start."""
    turn.set(deployment=msgspec.structs.replace(deployment, stage="starting", certificate_id=facts.id), ended="")
    runs.begin(turn, deployment.digest, facts.id)
    turn.emit(StartController(turn.now, deployment.digest, facts.id, deployment.scenarios))
    regate(turn)


def distrusted(turn: Turn, event: CertificatesDistrusted) -> None:
    """Whoever signed these is not believed any more, so they end for good. An unknown one is none that could drive here."""
    for facts in turn.memory.certificates:
        if facts.id in event.reasons:
            revoke(turn, [facts.id], f"key: {event.reasons[facts.id]}")


def revoke_controller(turn: Turn, digest: str, reason: str) -> None:
    """Ends all certificates of a controller."""
    revoke(turn, [facts.id for facts in turn.memory.certificates if facts.controller_digest == digest], reason)


def revoke_unsafe(turn: Turn) -> None:
    """After a run was counted: a controller whose lower limit was above `Settings.max_unsafe` loses its certificates (guarantee G10)."""
    if not any(isinstance(output, EpisodeCounted) for output in turn.outputs):
        return
    for digest in dict.fromkeys(facts.controller_digest for facts in turn.memory.certificates):
        if runs.refusal(turn.memory, turn.settings, digest):
            revoke_controller(turn, digest, runs.REASON)


def revoke(turn: Turn, ids: Sequence[str], reason: str) -> None:
    """Ends certificates for good. Closes the gate first, if one of them drives, and stops that controller last."""
    fresh = {identity: reason for identity in ids if identity not in turn.memory.revoked}
    if not fresh:
        return
    kept = tuple(facts for facts in turn.memory.certificates if facts.id not in fresh)
    turn.remember(revoked={**turn.memory.revoked, **fresh}, certificates=kept)
    regate(turn)
    turn.emit(*(Revoked(turn.now, identity, reason) for identity in fresh))
    turn.persist()
    deployment = turn.state.deployment
    if deployment is not None and deployment.certificate_id in fresh:
        end_deployment(turn, "certificate_revoked", f"refused: the certificate was revoked: {reason}")
