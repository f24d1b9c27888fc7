"""Stop what a request drives when the person who gave the command stops it, or is gone (docs/operating.md).

A campaign is interrupted: its samples are kept, and `s2r sample` goes on with it. Given inputs end for good. A controller that does not
drive yet is not deployed; one that drives was answered, and drives on. Work that moves nothing (gap, trace, verification) goes on.
"""

from __future__ import annotations

from s2r_runtime.core.drive import recover_now
from s2r_runtime.core.sources import end_deployment, interrupt_campaign
from s2r_runtime.core.state import Turn
from s2r_runtime.messages import Requested, Send


def pause(turn: Turn, request: Requested) -> None:
    """Stops the sampler, or withdraws a deployment. `request.count`: number of the request whose asker is gone, 0 for a person's pause."""
    campaign, deployment, number = turn.state.campaign, turn.state.deployment, request.count
    why = request.text or f"paused by user {request.by}"
    if campaign is not None and number in (0, campaign.request_id):
        interrupt_campaign(turn, why)
        if not any(isinstance(output, Send) for output in turn.outputs):
            recover_now(turn)
        what = f"the inputs, after {campaign.taken} of {campaign.n} rows"
        if not campaign.inputs:
            what = f"the campaign of epoch {campaign.epoch}, after {campaign.taken} of {campaign.n} samples; s2r sample goes on with it"
        turn.answer(request.request_id, 0, f"stopped {what}")
    elif number and deployment is not None and deployment.request_id == number:
        end_deployment(turn, "undeployed", f"not deployed: {why}; nothing drives")
        turn.answer(request.request_id, 0, "the deployment is withdrawn")
    else:
        turn.answer(request.request_id, 2, "the sampler drives nothing")
