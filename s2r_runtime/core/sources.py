"""Who may command, coming and going: sources that start and stop, campaigns and deployments that end, stops, the link.

Whatever ends a source while it drives closes the gate first, sends the recovery command next, and then tells the daemon to
stop the source and answers the request that it came from.
"""

from __future__ import annotations

import msgspec

from s2r_runtime import gate
from s2r_runtime.core.drive import close, forget_observations, latch, recover_now, regate
from s2r_runtime.core.state import Turn, situation
from s2r_runtime.messages import (
    GateChanged,
    LinkChanged,
    OverrideChanged,
    Send,
    SourceStarted,
    SourceStopped,
    StopCampaign,
    StopController,
)

INTERRUPTS = ("stopping", *gate.ALWAYS_LATCHING, "recorder_down", "no_permit", "permit_expired")
"""What ends a campaign for the moment; anything else only refuses its commands one by one."""
FAULTS = ("raised", "died", "deadline", "malformed", "inconsistent")


# ---------------------------------------------------------------- ends


def end_deployment(turn: Turn, reason: str, text: str, *, exit_code: int = 1, tell: bool = True) -> None:
    """There is no deployment any more. `reason`: for the daemon, and for the status if it is one of the gate's. `tell`: the
    controller's process may still be there. `text`: for the request that is still open.
    """
    deployment = turn.state.deployment
    if deployment is None:
        return
    turn.set(deployment=None, faults=0, ended=reason if reason in gate.REASONS else "")
    regate(turn)
    if turn.state.asked is not None and turn.state.asked.source == "controller":
        recover_now(turn)
    if tell and deployment.stage != "verifying":
        turn.emit(StopController(turn.now, reason))
    turn.answer(deployment.request_id, exit_code, text)


def fail_controller(turn: Turn, reason: str, detail: str, *, tell: bool) -> None:
    """The driving controller is at fault: closes the gate with `controller_fault`, which latches if the profile says so."""
    said = f"{reason}: {detail}" if detail else reason
    close(turn, "controller_fault", said)
    latch(turn, "controller_fault")
    if tell:
        turn.emit(StopController(turn.now, reason))
    end_deployment(turn, "controller_fault", f"refused: the controller failed ({said})", tell=False)


def interrupt_campaign(turn: Turn, reason: str, *, tell: bool = True, exit_code: int = 1, said: str = "") -> None:
    """The campaign stops sampling; its epoch stays begun, so that it can go on at no cost. Given inputs stop for good.

    said: the reason, for whoever waits for its end.
    """
    campaign = turn.state.campaign
    if campaign is None:
        return
    turn.set(campaign=None)
    asked = turn.state.asked
    if asked is not None and asked.source == "sampler":
        recover_now(turn)
    if tell:
        turn.emit(StopCampaign(turn.now, reason))
    why = said or reason
    text = f"campaign of epoch {campaign.epoch} stopped after {campaign.taken} of {campaign.n} samples: {why}; s2r sample goes on with it"
    if campaign.inputs:
        text = f"inputs stopped after {campaign.taken} of {campaign.n} rows: {why}"
    turn.answer(campaign.request_id, exit_code, text)


def check_campaign(turn: Turn) -> None:
    """Interrupts the campaign where the sampler may not drive any more."""
    campaign = turn.state.campaign
    if campaign is None:
        return
    refusal = gate.standing(turn.settings, situation(turn.state), "sampler", turn.now)
    waits = turn.state.recorder_late and not campaign.inputs  # given inputs with a hole in them are others
    if refusal is not None and refusal.reason == "recorder_down" and waits:
        return
    if refusal is not None and (refusal.reason in INTERRUPTS or refusal.reason.startswith("latched:")):
        interrupt_campaign(turn, refusal.reason)


# ---------------------------------------------------------------- sources


def source_started(turn: Turn, event: SourceStarted) -> None:
    """A source runs. One that nobody asked for is stopped."""
    if event.source == "sampler":
        campaign = turn.state.campaign
        if campaign is None:
            turn.emit(StopCampaign(turn.now, "not_requested"))
        else:
            turn.set(campaign=msgspec.structs.replace(campaign, running=True), sampler_seq=-1)
        return
    if event.source != "controller":
        return
    deployment = turn.state.deployment
    if deployment is None or deployment.stage == "verifying":
        turn.emit(StopController(turn.now, "not_requested"))
        return
    if deployment.stage == "running":
        fail_controller(turn, "malformed", "a second one started beside it", tell=True)
        return
    if event.digest != deployment.digest:
        end_deployment(turn, "digest_mismatch", f"refused: digest_mismatch: what started is {event.digest}, not {deployment.digest}")
        return
    running = msgspec.structs.replace(deployment, stage="running", running=event.digest, request_id=0)
    turn.set(deployment=running, controller_seq=-1, faults=0, driven=True)
    regate(turn)
    latched = ", ".join(turn.memory.latched)
    stays = f"; the gate stays closed until these are cleared: {latched}" if latched else ""
    turn.answer(deployment.request_id, 0, f"deployed under certificate {deployment.certificate_id}{stays}")


def source_stopped(turn: Turn, event: SourceStopped) -> None:
    """A source is gone."""
    deployment = turn.state.deployment
    if event.source == "sampler" and event.reason != "finished":
        interrupt_campaign(turn, f"{event.reason}: {event.detail}" if event.detail else event.reason, tell=False)
    elif event.source == "controller" and deployment is not None and deployment.stage != "verifying":
        if event.reason in FAULTS:
            fail_controller(turn, event.reason, event.detail, tell=False)
        else:
            why = f"{event.reason}: {event.detail}" if event.detail else event.reason
            end_deployment(turn, event.reason, f"refused: the controller is gone ({why})", tell=False)


# ---------------------------------------------------------------- stops


def override(turn: Turn, event: OverrideChanged) -> None:
    """A transport's emergency stop or manual override, or a second robot under this one's name."""
    if event.kind == "robot_twin":
        turn.set(fault=event.detail)
    stop(turn, event.kind, event.detail)


def stop(turn: Turn, kind: str, detail: str = "") -> None:
    """Latches, and everything stops: gate closed, recovery command out at once, sources stopped."""
    if kind not in turn.memory.latched:
        turn.remember(latched=(*turn.memory.latched, kind))
    halt(turn, kind, detail)


def halt(turn: Turn, reason: str, detail: str = "") -> None:
    """Closes the gate, sends the recovery command at once and stops every source."""
    close(turn, reason, detail)
    if not any(isinstance(output, Send) for output in turn.outputs):
        recover_now(turn)
    turn.set(idle=0)
    said = f"{reason}: {detail}" if detail and turn.settings.fault_share else reason
    interrupt_campaign(turn, reason, said=said)
    end_deployment(turn, reason, f"refused: {said}")


# ---------------------------------------------------------------- the robot's side


def link_changed(turn: Turn, event: LinkChanged) -> None:
    """The link went or came. What was observed before says nothing about after."""
    turn.set(link_up=event.up)
    regate(turn)
    if not event.up:
        forget_observations(turn)


def clock_stepped_back(turn: Turn) -> None:
    """The monotonic clock went backward: nothing timed by it holds any more. Goes on from the new reading."""
    close(turn, "clock_backwards")
    forget_observations(turn)
    turn.set(now_ns=turn.now, unix_ns=min(turn.state.unix_ns, turn.now), permit_until_ns=None, sent=None)


def memory_refused(turn: Turn, text: str) -> None:
    """The memory is another robot's or schema's: closed for good."""
    turn.set(refusal=text, gate_reason="memory_refused", gate_said="memory_refused")
    turn.emit(GateChanged(turn.now, open=False, reason="memory_refused", detail=text))
