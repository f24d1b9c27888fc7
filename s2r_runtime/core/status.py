"""What `s2r status` shows of the core's state: plain data, finite numbers, None where there is nothing (docs/json.md)."""

from __future__ import annotations

import math

import msgspec

from s2r_runtime import gate
from s2r_runtime.core import driven, ledger, runs, stream
from s2r_runtime.core.state import NANO, State, certificate, situation, unix_now, usable_gap
from s2r_runtime.messages import Decided, Memory, Output, Settings


def status(state: State) -> dict[str, object]:
    """What `s2r status` shows: plain data, finite numbers, None where there is nothing (docs/json.md)."""
    memory, settings, deployment, campaign = state.memory, state.settings, state.deployment, state.campaign
    facts, beta = certificate(state), 0.0 if settings is None else settings.beta
    spent = ledger.spent(beta, memory.epochs, memory.attempts)
    left_ns = 0 if state.permit_until_ns is None else max(0, state.permit_until_ns - state.now_ns)
    return {
        "gate": "open" if state.gate_open else "closed",
        "reason": state.gate_reason,
        "controller": None if deployment is None else deployment.digest,
        "stage": None if deployment is None else deployment.stage,
        "certificate": None if facts is None else facts.id,
        "clock_behind_s": state.clock_behind_s,
        "certificate_left_s": None if facts is None else facts.expires_unix_s - unix_now(state),
        "radius": None if memory.gap is None else memory.radius,
        "gap_radius": None if memory.gap is None else memory.gap.radius,
        "verified_radius": None if facts is None else facts.verified_radius,
        "headroom_used": None if facts is None else _ratio(memory.radius, facts.verified_radius),
        "samples_to_certificate": samples_to_certificate(state),
        "stream": _stream(state),
        "driven": driven.status(memory, settings),
        "e_value": state.e_value,
        "alarm": memory.gap is not None and memory.gap.epoch == memory.alarm_epoch,
        "epoch": memory.epochs,
        "attempts": memory.attempts,
        "beta": beta,
        "beta_spent": spent,
        "beta_left": max(0.0, beta - spent),
        "latched": list(memory.latched),
        "driving": None if state.sent is None else state.sent.source,
        "campaign": None
        if campaign is None or campaign.inputs
        else {"epoch": campaign.epoch, "taken": campaign.taken, "n": campaign.n, "running": campaign.running},
        "inputs": None
        if campaign is None or not campaign.inputs
        else {"digest": campaign.inputs, "driven": campaign.taken, "n": campaign.n, "running": campaign.running},
        "unfinished_epoch": memory.campaign_epoch or None,
        "refused_campaign": None if memory.refused_campaign is None else msgspec.structs.asdict(memory.refused_campaign),
        "next_campaign": None if settings is None else _next_campaign(settings, memory),
        "next_attempt": None if settings is None else {"attempt": memory.attempts + 1, "beta": ledger.share(beta, memory.attempts + 1)},
        "permit_left_s": left_ns / NANO,
        "jobs": [one.purpose for one in state.jobs],
        "measurement_faults": state.faults,
        "episodes": state.episodes,
        "runs": runs.status(memory, settings, "" if deployment is None else deployment.digest, "" if facts is None else facts.id),
        "model": memory.model_digest,
        "proposal": None
        if memory.proposal is None
        else {**msgspec.structs.asdict(memory.proposal), "adopt": None if settings is None else settings.adopt},
        "traced": memory.traced,
        "link": state.link_up,
    }


def _next_campaign(settings: Settings, memory: Memory) -> dict[str, object]:
    """What the next campaign spends and takes. n: None where no number of samples would do."""
    epoch = memory.epochs + 1
    share = ledger.share(settings.beta, epoch)
    try:
        n: int | None = max(ledger.campaign_size(settings.epsilon, share, settings.discard), settings.campaign_n)
    except ValueError:
        n = None
    return {"epoch": epoch, "beta": share, "n": n}


def _ratio(part: float, whole: float) -> float | None:
    """None where it is no finite number."""
    found = part / whole if whole > 0.0 else math.inf
    return found if math.isfinite(found) else None


def samples_to_certificate(state: State) -> int | None:
    """How many samples are lacking before a verification may be begun: 0 with a gap in force; of a campaign that was interrupted, at most.
    None: no number would do.
    """
    settings, memory, campaign = state.settings, state.memory, state.campaign
    if settings is None:
        return None
    if campaign is not None and not campaign.inputs:
        return max(0, campaign.n - campaign.taken)
    if usable_gap(state) is not None:
        return 0
    if memory.campaign_epoch:
        return memory.campaign_n
    try:
        needed = ledger.campaign_size(settings.epsilon, ledger.share(settings.beta, memory.epochs + 1), settings.discard)
    except ValueError:
        return None
    return max(needed, settings.campaign_n)


def _stream(state: State) -> dict[str, object] | None:
    """What driving shows of itself, under the gap in force; the bounds hold at all times at once, each with confidence 1 - alpha."""
    settings, memory = state.settings, state.memory
    if settings is None or memory.gap is None:
        return None
    n, exceedances, alpha = memory.watch_n, memory.watch_exceedances, settings.alpha
    return {
        "n": n,
        "exceedances": exceedances,
        "exceedance_upper": stream.share_above(exceedances, n, alpha),
        "quantile": stream.quantile(memory.watch_counts, memory.gap.radius, memory.gap.epsilon, alpha),
        "epsilon": memory.gap.epsilon,
        "alpha": alpha,
        "e_value": state.e_value,
        "alarm_at": 1.0 / alpha,
        "change": memory.watch_change,
        "change_at": settings.run_length,
        "exchange": memory.watch_exchange,
        "exchange_at": 1.0 / alpha,
    }


def against_sampler(state: State, outputs: tuple[Output, ...]) -> str:
    """Why the recovery command went out in the sampler's place. state: after the event, outputs: of the event.

    The gate's verdict on its command where there is one, otherwise what stands against it now; `interrupted` if nothing does any more.
    """
    for output in outputs:
        if isinstance(output, Decided) and output.source == "sampler" and not output.allow:
            return output.reason
    refusal = None if state.settings is None else gate.standing(state.settings, situation(state), "sampler", state.now_ns)
    return "interrupted" if refusal is None else refusal.reason
