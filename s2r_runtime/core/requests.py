"""What a person asks for, over the control socket. Every request gets exactly one final answer, at once or when it is done.

Exit codes as on the command line: 0 it holds, 1 it does not hold (refused), 2 it made no sense, 3 not enough evidence, 78 bad
configuration.
"""

from __future__ import annotations

import math

import msgspec

from s2r_runtime import gate
from s2r_runtime.core import driven, faults, runs, wall_clock
from s2r_runtime.core.certificates import begin_verification, refusal_to_verify, revoke, start_controller, valid_certificate
from s2r_runtime.core.drive import recover_now, regate
from s2r_runtime.core.excitation import begin_inputs
from s2r_runtime.core.gaps import RETRY, begin_campaign
from s2r_runtime.core.leaving import pause
from s2r_runtime.core.repair import requested_adoption, requested_trace
from s2r_runtime.core.sources import check_campaign, end_deployment, interrupt_campaign, stop
from s2r_runtime.core.state import NANO, Deployment, Turn, job, situation
from s2r_runtime.messages import Requested, StopCampaign

LONGEST_PERMIT_S = 86_400.0
"""A permit is a person's presence, given for a limited time; nobody watches a robot for longer than a day."""

HINTS = {
    "no_permit": "give one: s2r permit DURATION",
    "permit_expired": "give another: s2r permit DURATION",
    "emergency_stop": "s2r clear emergency_stop, when it is safe",
    "manual_override": "s2r clear manual_override, when it is safe",
    "robot_twin": "two robots answer to one name; switch one off, then s2r clear robot_twin",
    "observation_faults": "too many observations are faulty (s2r status); mend it, then s2r clear observation_faults",
    "link_down": "the robot is not there",
    "recorder_down": "nothing can be recorded; is the disk full?",
    "observation_missing": "nothing was observed yet",
    "observation_stale": "the robot is not observed any more",
    "outside_geofence": "the sampler may only drive inside it; bring the robot back",
}


def requested(turn: Turn, request: Requested) -> None:
    """Does what is asked, or says why not."""
    match request.verb:
        case "deploy":
            _deploy(turn, request)
        case "verify":
            _verify(turn, request)
        case "undeploy":
            _undeploy(turn, request)
        case "revoke":
            _revoke(turn, request)
        case "adopt":
            requested_adoption(turn, request)
        case "clear":
            _clear(turn, request)
        case "stop":
            stop(turn, "emergency_stop", f"by user {request.by}")
            turn.persist()
            turn.answer(request.request_id, 0, "stopped; nothing drives until: s2r clear emergency_stop")
        case "permit":
            _permit(turn, request)
        case "sample":
            _sample(turn, request)
        case "excite":
            _excite(turn, request)
        case "cancel":
            _cancel(turn, request)
        case "pause":
            pause(turn, request)
        case "trace":
            requested_trace(turn, request)


def _deploy(turn: Turn, request: Requested) -> None:
    state, digest = turn.state, request.digest
    stopped = next((reason for reason in gate.ALWAYS_LATCHING if reason in turn.memory.latched), "")
    if not digest:
        turn.answer(request.request_id, 2, "deploy needs a controller")
    elif (
        state.deployment is not None
        and state.deployment.stage == "running"
        and state.deployment.digest == digest
        and not _compared(turn, request)
    ):
        turn.answer(request.request_id, 0, "this controller is deployed already")
    elif state.deployment is not None:
        turn.answer(request.request_id, 2, "another deployment is in force or under way; first: s2r undeploy")
    elif stopped:
        turn.answer(request.request_id, 1, f"refused: {_hinted(turn, stopped)}")
    elif state.campaign is not None or job(state, "gap") is not None:
        turn.answer(request.request_id, 1, "refused: a campaign is under way")
    elif exceeded := driven.refusal(turn.memory, turn.settings) or runs.refusal(turn.memory, turn.settings, digest):
        turn.answer(request.request_id, 1, f"refused: {exceeded}")
    elif (facts := valid_certificate(turn, digest)) is not None:
        start_controller(turn, Deployment(digest, request.request_id, "starting", scenarios=request.scenarios), facts)
    elif request.scenarios is not None:
        turn.answer(
            request.request_id, 1, "refused: no certificate covers this controller; a comparison spends no attempt: s2r deploy first"
        )
    elif refusal := refusal_to_verify(turn):
        turn.answer(request.request_id, 1, f"refused: {refusal}")
    else:
        turn.set(deployment=Deployment(digest, request.request_id, "verifying"), ended="")
        begin_verification(turn, "deploy", digest, request.request_id)


def _compared(turn: Turn, request: Requested) -> bool:
    """Whether this request or the deployment in force is of a comparison: then one is not the other."""
    deployment = turn.state.deployment
    return request.scenarios is not None or (deployment is not None and deployment.scenarios is not None)


def _verify(turn: Turn, request: Requested) -> None:
    if not request.digest:
        turn.answer(request.request_id, 2, "verify needs a controller")
    elif exceeded := runs.refusal(turn.memory, turn.settings, request.digest):
        turn.answer(request.request_id, 1, f"refused: {exceeded}")
    elif refusal := refusal_to_verify(turn):
        turn.answer(request.request_id, 1, f"refused: {refusal}")
    else:
        begin_verification(turn, "verify", request.digest, request.request_id)


def _undeploy(turn: Turn, request: Requested) -> None:
    if turn.state.deployment is None:
        turn.answer(request.request_id, 2, "no controller is deployed")
        return
    end_deployment(turn, "undeployed", "refused: undeployed before it drove")
    turn.answer(request.request_id, 0, "undeployed")


def _revoke(turn: Turn, request: Requested) -> None:
    known = [facts.id for facts in turn.memory.certificates]
    if not request.text:
        revoke(turn, known, "by_operator")
        turn.answer(request.request_id, 0, f"{len(known)} certificates revoked" if known else "there is no certificate to revoke")
    elif request.text in known:
        revoke(turn, [request.text], "by_operator")
        turn.answer(request.request_id, 0, f"certificate {request.text} revoked")
    elif request.text in turn.memory.revoked:
        turn.answer(request.request_id, 0, f"certificate {request.text} was revoked before: {turn.memory.revoked[request.text]}")
    else:
        turn.answer(request.request_id, 2, f"no certificate {request.text}; in force: {', '.join(known) or 'none'}")


def _clear(turn: Turn, request: Requested) -> None:
    reason, latched = request.text.removeprefix("latched:"), turn.memory.latched
    if reason == wall_clock.REASON:
        wall_clock.clear(turn, request.request_id)
        regate(turn)
        return
    if reason == runs.REASON:
        runs.clear(turn, request.request_id)
        return
    if reason == driven.REASON and turn.memory.driven:
        turn.remember(driven=())
        turn.persist()
        turn.answer(request.request_id, 0, "what earlier driving showed is forgotten; the watch goes on")
        return
    if reason not in latched:
        held = f"latched: {', '.join(latched)}" if latched else "nothing is latched"
        turn.answer(request.request_id, 2, f"{reason or 'no reason'} is not latched; {held}")
        return
    turn.remember(latched=tuple(other for other in latched if other != reason))
    turn.persist()
    if reason == "measurement_faults":
        turn.set(faults=0)
    if reason == faults.REASON:
        faults.forgive(turn)
    if reason == turn.state.ended:
        turn.set(ended="")
    regate(turn)
    still = "; the gap stays refuted, sample anew: s2r sample" if reason == "watch_alarm" and turn.memory.alarm_epoch else ""
    turn.answer(request.request_id, 0, f"{reason} cleared{still}")


def _permit(turn: Turn, request: Requested) -> None:
    seconds = request.duration_s
    if not (math.isfinite(seconds) and 0.0 <= seconds <= LONGEST_PERMIT_S):
        turn.answer(request.request_id, 2, f"a permit lasts 0 (none) to {LONGEST_PERMIT_S:g} s, not {seconds}")
        return
    turn.set(permit_until_ns=turn.now + round(seconds * NANO) if seconds > 0.0 else None)
    check_campaign(turn)
    turn.answer(request.request_id, 0, f"the sampler may drive for {seconds:g} s" if seconds > 0.0 else "the sampler may not drive")


def _sample(turn: Turn, request: Requested) -> None:
    if request.count < 0:
        turn.answer(request.request_id, 2, f"{request.count} samples make no campaign")
    elif _sampler_may_drive(turn, request):
        begin_campaign(turn, request.count, request.request_id, retry=request.text == RETRY)


def _excite(turn: Turn, request: Requested) -> None:
    if not request.digest or request.count < 1:
        turn.answer(request.request_id, 2, "there are no inputs to drive")
    elif _sampler_may_drive(turn, request):
        begin_inputs(turn, request.digest, request.count, request.request_id)


def _sampler_may_drive(turn: Turn, request: Requested) -> bool:
    """Whether nothing stands against the sampler; if something does, that is the answer."""
    state = turn.state
    ready = msgspec.structs.replace(situation(state), campaign_running=True)
    refusal = gate.standing(turn.settings, ready, "sampler", turn.now)
    if state.campaign is not None or job(state, "gap") is not None:
        what = "inputs are being driven" if state.campaign is not None and state.campaign.inputs else "a campaign is under way"
        turn.answer(request.request_id, 2, f"{what} already")
    elif state.deployment is not None:
        turn.answer(request.request_id, 1, "refused: a controller is deployed; undeploy it first")
    elif refusal is not None:
        turn.answer(request.request_id, 1, f"refused: {_hinted(turn, refusal.reason)}")
    else:
        return True
    return False


def _hinted(turn: Turn, reason: str) -> str:
    """A reason of the gate with what is known of it, and what helps."""
    hint, fault = HINTS.get(reason.removeprefix("latched:"), ""), turn.state.fault if turn.settings.fault_share else ""
    said = fault if reason in ("observation_invalid", "robot_twin", "observation_faults") else ""
    return ": ".join(part for part in (reason, said, hint) if part)


def _cancel(turn: Turn, request: Requested) -> None:
    campaign, asked, epoch = turn.state.campaign, turn.state.asked, turn.memory.campaign_epoch
    if campaign is not None and campaign.inputs:
        interrupt_campaign(turn, "cancelled")
        turn.answer(request.request_id, 0, f"inputs cancelled after {campaign.taken} of {campaign.n} rows")
        return
    if job(turn.state, "gap") is not None or not epoch:
        turn.answer(request.request_id, 2, "there is no campaign to cancel")
        return
    turn.set(campaign=None)
    if asked is not None and asked.source == "sampler":
        recover_now(turn)
    if campaign is not None:
        turn.emit(StopCampaign(turn.now, "cancelled"))
        turn.answer(campaign.request_id, 1, f"campaign of epoch {epoch} cancelled after {campaign.taken} of {campaign.n} samples")
    turn.remember(campaign_epoch=0, campaign_n=0)
    turn.persist()
    turn.answer(request.request_id, 0, f"campaign of epoch {epoch} cancelled; its share of beta is spent")
