"""Given inputs, driven as they stand in a file: by the sampler, under the permit, inside geofence and input bounds, as a campaign is.

They are no campaign: somebody chose them, so what comes of them is no independent sample of anything and founds no gap (guarantee G1). What
they are for is the tracer. A sequence with a hole in it is not the one that was asked for, so whatever puts the recovery command in the
place of one of its rows ends it.
"""

from __future__ import annotations

import msgspec

from s2r_runtime.core.drive import recover_now
from s2r_runtime.core.repair import begin_trace
from s2r_runtime.core.sources import interrupt_campaign
from s2r_runtime.core.state import Campaign, Turn, job
from s2r_runtime.messages import Decided, Event, InputsFinished, Proposed, Send, StartInputs

NO_GAP = "these inputs were chosen, not drawn, so they are no independent samples and found no gap"


def begin_inputs(turn: Turn, digest: str, rows: int, request_id: int) -> None:
    """The sampler is told to drive them."""
    turn.set(campaign=Campaign(0, rows, request_id, inputs=digest), excited=True)
    turn.emit(StartInputs(turn.now, digest, rows))


def follow_inputs(turn: Turn, event: Event) -> None:
    """At the end of every event: counts the rows that were driven, and ends the sequence where one was not."""
    campaign = turn.state.campaign
    if campaign is None or not campaign.inputs or not campaign.running:
        return
    sources = [output.source for output in turn.outputs if isinstance(output, Send)]
    if "sampler" in sources and isinstance(event, Proposed):
        campaign = msgspec.structs.replace(campaign, taken=campaign.taken + 1)
        turn.set(campaign=campaign)
    refused = [output.reason for output in turn.outputs if isinstance(output, Decided) and output.source == "sampler" and not output.allow]
    if refused or ("recovery" in sources and campaign.taken):
        interrupt_campaign(turn, refused[0] if refused else turn.state.trouble or "the robot was not seen, or not answered, in time")


def inputs_finished(turn: Turn, event: InputsFinished) -> None:
    """All rows are driven, or no more of them will be. What was driven is traced, if the profile says so."""
    campaign, asked = turn.state.campaign, turn.state.asked
    if campaign is not None and campaign.inputs == event.digest:
        turn.set(campaign=None)
        if asked is not None and asked.source == "sampler":
            recover_now(turn)
        if event.complete and event.n == campaign.n:
            turn.answer(
                campaign.request_id, 0, f"{event.n} rows driven and recorded; no gap: {NO_GAP}. See what they show: s2r trace --live inputs"
            )
        else:
            why = f": {event.detail}" if event.detail else ""
            turn.answer(campaign.request_id, 1, f"inputs ended after {event.n} of {campaign.n} rows{why}")
    if turn.settings.trace_after_inputs and event.n and not turn.state.stopping and job(turn.state, "trace") is None:
        begin_trace(turn, "inputs", 0)
