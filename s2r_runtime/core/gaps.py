"""Campaigns, the gap that they found, how it grows, and the watch that refutes it (guarantee G1, G4, G5).

Epoch i is spent when its campaign is begun: persisted first. The gap of a finished campaign ends every certificate of the one
before. While it is in force, a discrepancy above it makes the radius grow at once, and an alarm of the watch ends it.
"""

from __future__ import annotations

import msgspec

from s2r_runtime import gate
from s2r_runtime.core import driven, ledger, stream
from s2r_runtime.core.certificates import ROUNDING, facts_problem, install, reverify_if_due, revoke
from s2r_runtime.core.drive import latch, recover_now, regate
from s2r_runtime.core.sources import end_deployment
from s2r_runtime.core.state import Campaign, Job, Turn, certificate, job, situation, usable_gap
from s2r_runtime.messages import (
    NOT_INDEPENDENT,
    REPEATED,
    SERIAL,
    AlarmRaised,
    CampaignFinished,
    CertificateStored,
    ChangeNoticed,
    EpochChanged,
    Gap,
    JobFinished,
    Measured,
    RadiusGrew,
    RefusedCampaign,
    StartCampaign,
    StartJob,
)

REFUTED = 100
"""Gaps that ended refuted or outgrown, whose samples are remembered, the newest. Each took a campaign at a share of beta that falls as
1 / i^2, so a robot has few; 100 of them are 7 KB of what is persisted.
"""

GOOD_REFUSED = 200
"""Of so many campaigns whose samples are independent, the test of their order refuses one at most (`whiteness.SERIAL_ALPHA`)."""
RETRY = "retry"
"""The text of a request to sample, and to repeat it once if it is refused so."""

# ---------------------------------------------------------------- campaigns


def begin_campaign(turn: Turn, count: int, request_id: int, *, retry: bool = False) -> None:
    """Begins a campaign, or goes on with one that was begun. count: number of samples, 0: the profile's. retry: as in `Campaign`."""
    memory, settings = turn.memory, turn.settings
    resume = memory.campaign_epoch > 0
    epoch = memory.campaign_epoch if resume else memory.epochs + 1
    share = ledger.share(settings.beta, epoch)
    n = memory.campaign_n if resume else count or settings.campaign_n
    if resume and count not in (0, n):
        turn.answer(request_id, 2, f"the campaign of epoch {epoch} fixed {n} samples when it began; ask for {n}, or cancel it first")
        return
    try:
        needed = ledger.campaign_size(settings.epsilon, share, settings.discard)
    except ValueError as error:
        turn.answer(request_id, 3, f"epoch {epoch}: {error}")
        return
    n = n or needed
    if n < needed:
        asked = f"epoch {epoch} needs at least {needed} samples at epsilon {settings.epsilon:g} with {settings.discard} discarded"
        turn.answer(request_id, 3, f"{asked}; {n} are {needed - n} too few")
        return
    turn.set(campaign=Campaign(epoch, n, request_id, retry=retry))
    if not resume:
        turn.remember(epochs=epoch, campaign_epoch=epoch, campaign_n=n)
        turn.persist()
        turn.emit(EpochChanged(turn.now, epoch, share))
    seed = ledger.seed("campaign", settings.robot, memory.model_digest, settings.profile_digest, settings.seed, epoch)
    turn.emit(StartCampaign(turn.now, epoch, n, share, seed, resume))


def campaign_finished(turn: Turn, event: CampaignFinished) -> None:
    """All samples are there: the gap is computed. Or they are not: the epoch stays begun, and a person may go on with it."""
    campaign, asked = turn.state.campaign, turn.state.asked
    if campaign is None or campaign.inputs or event.epoch != campaign.epoch:
        return
    turn.set(campaign=None)
    if asked is not None and asked.source == "sampler":
        recover_now(turn)
    if not event.complete or event.n != campaign.n:
        why = f": {event.detail}" if event.detail else ""
        text = f"campaign of epoch {event.epoch} ended after {event.n} of {campaign.n} samples{why}; s2r sample goes on with it"
        turn.answer(campaign.request_id, 3, text)
        return
    one = Job(turn.state.next_job, "gap", campaign.request_id, campaign.epoch, retry=campaign.retry)
    turn.add_job(one)
    turn.emit(StartJob(turn.now, one.id, "gap", epoch=one.epoch, beta=ledger.share(turn.settings.beta, one.epoch)))
    turn.answer(one.request_id, 0, f"{campaign.n} samples taken; computing the gap", final=False)


# ---------------------------------------------------------------- the gap in force


def gap_finished(turn: Turn, done: Job, event: JobFinished) -> None:
    """The campaign's gap comes into force."""
    gap = event.gap
    if gap is not None and not event.error and gap.white_reason.startswith(NOT_INDEPENDENT):
        _not_independent(turn, done, gap)
        return
    problem = event.error or ("the worker returned none" if gap is None else _gap_problem(turn, gap, done.epoch))
    if gap is None or problem:
        turn.answer(done.request_id, 1, f"no gap: {problem}; s2r sample tries again with the samples that are there")
        return
    turn.remember(campaign_epoch=0, campaign_n=0, traced=False)
    _enforce(turn, gap)
    turn.answer(done.request_id, 0, f"gap of epoch {gap.epoch}: {gap.radius:.6g} at epsilon {gap.epsilon:g}, from {gap.n} samples")


def _not_independent(turn: Turn, done: Job, gap: Gap) -> None:
    """The samples depend on each other, so they bound nothing (guarantee G1): the campaign is given up, and its share stays spent."""
    turn.remember(campaign_epoch=0, campaign_n=0)
    why = f"the samples of epoch {gap.epoch} were not drawn independently: {gap.white_reason}; they bound nothing"
    if turn.settings.rules < 1:
        turn.persist()
        turn.answer(done.request_id, 3, f"no gap: {why}, and their share of beta is spent: find out what drifts before the next campaign")
        return
    before = turn.memory.refused_campaign
    share, in_a_row = ledger.share(turn.settings.beta, gap.epoch), 1 if before is None else before.in_a_row + 1
    turn.remember(refused_campaign=RefusedCampaign(gap.epoch, gap.n, share, gap.white_reason, in_a_row))
    turn.persist()
    standing = gate.standing(turn.settings, msgspec.structs.replace(situation(turn.state), campaign_running=True), "sampler", turn.now)
    repeats = done.retry and in_a_row == 1 and standing is None and gap.white_reason.startswith(SERIAL)
    text = f"no gap: {why}, and their share of beta ({share:.2g}) is spent. {_after_refusal(turn, gap, in_a_row, repeats=repeats)}"
    if done.retry and standing is not None:
        text += f" Not repeated: {standing.reason}."
    turn.answer(done.request_id, 3, text, final=not repeats)
    if repeats:
        begin_campaign(turn, 0 if gap.n < _samples_of_next(turn) else gap.n, done.request_id)


def _after_refusal(turn: Turn, gap: Gap, in_a_row: int, *, repeats: bool) -> str:
    """What a refusal means, and what to do about it."""
    if gap.white_reason.startswith(REPEATED):
        return "Look for what plays a recording instead of the robot, and for a sensor that is stuck."
    epoch = turn.memory.epochs + 1
    costs = f"epoch {epoch} takes {_samples_of_next(turn)} samples and spends {ledger.share(turn.settings.beta, epoch):.2g}"
    look = "Look at what changes while it samples (battery, temperature, tyres, localisation): s2r trace --live campaign, s2r report LOG."
    if in_a_row > 1:
        return (
            f"The test refuses at most 1 in {GOOD_REFUSED} good campaigns; {in_a_row} in a row are hardly chance: the robot drifts. {look}"
        )
    chance = f"The test refuses at most 1 in {GOOD_REFUSED} good campaigns, so once may be chance"
    if repeats:
        return f"{chance}; it is repeated now ({costs}). {look}"
    return f"{chance} and repeating is right: s2r sample PROFILE --retry ({costs}). {look}"


def _samples_of_next(turn: Turn) -> int:
    """How many samples the next epoch needs at least; 0 if no number would do (its campaign says so)."""
    settings = turn.settings
    try:
        return max(
            ledger.campaign_size(settings.epsilon, ledger.share(settings.beta, turn.memory.epochs + 1), settings.discard),
            settings.campaign_n,
        )
    except ValueError:
        return 0


def _gap_problem(turn: Turn, gap: Gap, epoch: int) -> str:
    """Why this gap does not carry its statement (guarantee G1), or empty."""
    settings = turn.settings
    if gap.epoch != epoch or gap.model_digest != turn.memory.model_digest:
        return "it is of another epoch or model"
    if not all(gate.finite(value) and value >= 0.0 for value in (gap.radius, gap.hold_radius)):
        return "its radius is not a finite number >= 0"
    if gap.epsilon != settings.epsilon or gap.discarded != settings.discard:
        return "its epsilon or discards are not the profile's"
    if settings.norm_weights and (gap.set, gap.weights) != (settings.norm_set, settings.norm_weights):
        return f"its norm is a {gap.set} with weights {gap.weights}, the profile's a {settings.norm_set} with {settings.norm_weights}"
    if gap.white_reason.startswith(NOT_INDEPENDENT):
        return f"its samples were not drawn independently: {gap.white_reason}"
    half = 0.5 * ledger.share(settings.beta, epoch)
    if ledger.binomial_tail(gap.n, gap.discarded, gap.epsilon) > half * (1.0 + ROUNDING):
        return f"{gap.n} samples are too few for the share of epoch {epoch}"
    return ""


def _enforce(turn: Turn, gap: Gap) -> None:
    old = [facts.id for facts in turn.memory.certificates]
    before = turn.memory.gap
    if before is not None and (usable_gap(turn.state) is None or turn.memory.radius > before.radius):
        _distrust(turn, before)
    _watch_anew(turn)
    epochs = max(turn.memory.epochs, gap.epoch)
    turn.remember(
        gap=gap, radius=gap.radius, epochs=epochs, alarm_epoch=0, campaign_digest=turn.settings.campaign_digest, refused_campaign=None
    )
    revoke(turn, old, "new_epoch")
    turn.persist()
    turn.emit(EpochChanged(turn.now, gap.epoch, ledger.share(turn.settings.beta, gap.epoch), gap))


def _distrust(turn: Turn, gap: Gap) -> None:
    """What the gap's samples said was seen not to hold: they found no later epoch."""
    known = tuple(digest for digest in turn.memory.refuted if digest != gap.transitions_digest)
    turn.remember(refuted=(*known, gap.transitions_digest)[-REFUTED:])


def void_gap(turn: Turn, reason: str) -> None:
    """No gap any more, nor an unfinished campaign; certificates end with it. Counters stay: what is spent is spent."""
    old = [facts.id for facts in turn.memory.certificates]
    _watch_anew(turn)
    turn.remember(gap=None, radius=0.0, campaign_epoch=0, campaign_n=0, alarm_epoch=0, traced=False, refused_campaign=None)
    revoke(turn, old, reason)


def _watch_anew(turn: Turn) -> None:
    """The gap in force ends, and its watch with it. What that showed of driving is kept."""
    if turn.settings.rules >= 3:
        turn.remember(driven=driven.kept(turn.memory, turn.settings.alpha))
    turn.remember(gap_attempts=0, behaviours=())
    turn.remember(watch_n=0, watch_exceedances=0, watch_e_value=1.0, watch_change=0.0, watch_exchange=1.0, watch_counts=())


def certificate_loaded(turn: Turn, event: CertificateStored, gap: Gap) -> None:
    """A certificate came from a file, with the gap that it rests on: that of this epoch, or one that founds a later epoch."""
    facts, memory = event.facts, turn.memory
    same = memory.gap is not None and (memory.gap.epoch, memory.gap.transitions_digest) == (gap.epoch, gap.transitions_digest)
    problem = ""
    if same:
        if usable_gap(turn.state) is None:
            problem = f"the watch refuted the gap of epoch {gap.epoch}"
    elif gap.epoch <= memory.epochs:
        problem = f"it rests on a gap of epoch {gap.epoch}, and {memory.epochs} have begun here"
    elif turn.state.campaign is not None or job(turn.state, "gap") is not None:
        problem = "a campaign is under way"
    else:
        problem = _gap_problem(turn, gap, gap.epoch) or _samples_problem(turn, gap)
    if not problem:
        grounded = facts.epoch == gap.epoch and facts.model_digest == gap.model_digest
        problem = "" if grounded else "its gap is of another epoch or model"
    problem = problem or facts_problem(turn, facts, facts.controller_digest, gap.epoch, 0.0)
    if problem:
        turn.answer(event.request_id, 1, f"certificate {facts.id} refused: {problem}", final=False)
        return
    if not same:
        _enforce(turn, gap)  # only now: a certificate that is refused changes nothing
    install(turn, facts)
    turn.answer(event.request_id, 0, f"certificate {facts.id} loaded", final=False)


def _samples_problem(turn: Turn, gap: Gap) -> str:
    """Why this gap's samples found no later epoch here, or empty: under another number they would forget what was seen since."""
    now = turn.memory.gap
    if now is not None and now.transitions_digest == gap.transitions_digest:
        return f"its gap rests on the samples of epoch {now.epoch}; a later epoch needs samples of its own"
    if gap.transitions_digest in turn.memory.refuted:
        return "its gap rests on samples whose gap was refuted or outgrown here; sample anew: s2r sample"
    return ""


# ---------------------------------------------------------------- the watch


def measured(turn: Turn, event: Measured) -> None:
    """One discrepancy of the stream. Beyond the radius the gap grows; the gate closes first where that leaves what was verified."""
    gap = usable_gap(turn.state)
    if gap is None or event.epoch not in (0, gap.epoch):
        return
    told = all(gate.finite(value) and value >= 0.0 for value in (event.e_value, event.change, event.exchange))
    counts = not event.fault and gate.finite(event.discrepancy) and event.discrepancy >= 0.0
    if not (told and counts):
        turn.set(faults=turn.state.faults + 1)  # a deployment that begins counts from 0
    if not counts:
        regate(turn)
        return
    noticed = turn.memory.watch_exchange
    if told:
        _counted(turn, event, gap)
    grew = event.discrepancy > turn.memory.radius  # whatever became of the evidence: no rule rejected this discrepancy
    if grew:
        turn.remember(radius=event.discrepancy)
    alarm = told and event.e_value >= 1.0 / turn.settings.alpha
    if alarm:
        turn.remember(alarm_epoch=gap.epoch)
    facts = certificate(turn.state)
    regate(turn)
    if grew:
        verified = facts.verified_radius if facts is not None else 0.0
        turn.emit(RadiusGrew(turn.now, turn.memory.radius, verified, event.obs_seq))
    if told and event.change >= turn.settings.run_length:
        turn.emit(ChangeNoticed(turn.now, "change", event.change, turn.settings.run_length, gap.epoch, event.obs_seq))
    bar = 1.0 / turn.settings.alpha
    if told and noticed < bar <= event.exchange:
        turn.emit(ChangeNoticed(turn.now, "exchangeability", event.exchange, bar, gap.epoch, event.obs_seq))
    if alarm:
        _alarm(turn, event, gap)
    turn.persist()
    reverify_if_due(turn)


def _counted(turn: Turn, event: Measured, gap: Gap) -> None:
    """Where the watch stands. A write each would be too many: it is written with what is remembered next, and as soon as the evidence has
    doubled since, so that a daemon that is killed forgets less than a factor of two of it.
    """
    now = stream.after(stream.stood(turn.memory), event, gap.radius)
    changed = msgspec.structs.replace(
        turn.memory,
        watch_n=now.n,
        watch_exceedances=now.exceedances,
        watch_e_value=now.e_value,
        watch_change=now.change,
        watch_exchange=now.exchange,
        watch_counts=now.counts,
    )
    turn.set(memory=changed)
    if event.e_value >= 2.0 * max(1.0, turn.state.saved_e_value):
        turn.remember()


def _alarm(turn: Turn, event: Measured, gap: Gap) -> None:
    """The gap is refuted: everything that rests on it ends."""
    latch(turn, "watch_alarm")
    _distrust(turn, gap)
    turn.emit(AlarmRaised(turn.now, event.e_value, turn.settings.alpha, gap.epoch))
    old = [facts.id for facts in turn.memory.certificates if facts.epoch == gap.epoch]
    end_deployment(turn, "watch_alarm", f"refused: watch_alarm: the gap of epoch {gap.epoch} was refuted")
    revoke(turn, old, "watch_alarm")
