"""What the robot is told: control instants, questions to the sources, the gate's state, the recovery command.

A *control instant* is the observation nearest to a point of the model's grid: the first instant's stamp plus whole steps of dt, by the
robot's clock. Half of the last interval between two observations decides which one is nearest before the next one arrives, and the grid
itself never moves, so that instants do not drift. (Runs under rules before `GRID` took any observation 0.9 dt after the last instant.) In
lockstep a robot that reports once a step waits for each answer: there its own steps are the grid. Each instant gets exactly one `Send`:
the command of the source that was asked, if the gate allows it, else the recovery command. Beyond that, in real time only, the
recovery command goes out at once when the gate closes between instants, and at the pace of dt while observations fail to come.

In lockstep the robot's clock stands still while nobody answers. With no source to ask, `settle_periods` instants get the
recovery command; then the core is silent, until a source becomes active (which is asked at once about the instant that waits) or a
person stops. A repeated observation never begins an instant of its own. If the robot repeats one twice whose
command was sent, the command was lost on the way and goes out again, the same one.
"""

from __future__ import annotations

from typing import Literal

import msgspec

from s2r_runtime import gate
from s2r_runtime.core import goto
from s2r_runtime.core.state import Asked, Turn, situation
from s2r_runtime.messages import GRID, AnswerLate, Ask, Command, Decided, GateChanged, Observation, Send, Source

RETURNED_WITHIN_M = 0.05
"""`return` stops this near to home: the go-to law is exponential, it would never arrive."""
LOST_AFTER_REPEATS = 2
"""One repetition may have crossed the command on its way; a second, 0.1 s later, means that it did not arrive."""


# ---------------------------------------------------------------- the gate's state


def regate(turn: Turn) -> None:
    """Looks at the gate's standing conditions again, and opens or closes it. Every change of facts ends with this."""
    refusal = gate.standing(turn.settings, situation(turn.state), "controller", turn.now)
    if refusal is not None:
        reason = refusal.reason
        said = turn.state.fault if reason == "observation_invalid" and turn.settings.fault_share else ""
        close(turn, turn.state.ended if reason == "no_controller" and turn.state.ended else reason, said)
        return
    since = turn.state.clear_since_ns
    if since is None:
        since = turn.now
        turn.set(clear_since_ns=since, gate_reason="settling")
    if turn.now - since >= turn.settings.hysteresis_ns:
        _open(turn)


def _open(turn: Turn) -> None:
    if not turn.state.gate_open:
        turn.set(gate_open=True, gate_reason=gate.ALLOWED, gate_said=gate.ALLOWED)
        turn.emit(GateChanged(turn.now, open=True, reason=gate.ALLOWED))


def close(turn: Turn, reason: str, detail: str = "") -> None:
    """Closes the gate, or notes another reason why it is closed. Closing acts first: the recovery command is the next output."""
    was_open, bare = turn.state.gate_open, reason.removeprefix("latched:")
    changed = was_open or bare != turn.state.gate_said
    turn.set(gate_open=False, gate_reason=reason, gate_said=bare, clear_since_ns=None)
    if changed:
        turn.emit(GateChanged(turn.now, open=False, reason=reason, detail=detail))
    if was_open:
        recover_now(turn)
    if reason in gate.ABOUT_COMMAND or (was_open and reason == bare):
        latch(turn, reason)


def latch(turn: Turn, reason: str) -> None:
    """Keeps the gate closed until a person clears the reason, if the profile or the design says that it latches."""
    latching = reason in turn.settings.latching or reason in gate.ALWAYS_LATCHING
    if latching and reason not in turn.memory.latched:
        turn.remember(latched=(*turn.memory.latched, reason))


# ---------------------------------------------------------------- what is sent


def recover_now(turn: Turn) -> None:
    """Sends the recovery command at once: as the answer to the instant that waits for one, if there is one. In lockstep only so,
    because there the robot takes one command per observation.
    """
    if not (turn.settings.lockstep and turn.state.answered):
        _send_recovery(turn, _instant(turn))


def _instant(turn: Turn) -> int:
    """Number of the newest control instant; -1: none yet, or none since the robot's sequence began anew."""
    return -1 if turn.state.control_seq is None else turn.state.control_seq


def _send_recovery(turn: Turn, obs_seq: int) -> None:
    _send(turn, "recovery", recovery_input(turn), obs_seq, turn.settings.command_ttl_ns)


def _send(turn: Turn, source: Source, u: tuple[float, ...], obs_seq: int, ttl_ns: int) -> None:
    send = Send(turn.now, turn.state.send_seq + 1, source, u, obs_seq, ttl_ns)
    turn.set(send_seq=send.seq, sent=send, answered=True, asked=None)
    turn.emit(send)


def recovery_input(turn: Turn) -> tuple[float, ...]:
    """The recovery command, (nu,): finite and inside the input bounds whatever the state holds.

    Under an emergency stop or a manual override it is zero, which stops the robot, whatever the profile's recovery is.
    """
    settings, state = turn.settings, turn.state
    u: tuple[float, ...] = ()
    if state.stopping or any(reason in state.memory.latched for reason in gate.ALWAYS_LATCHING):
        pass
    elif settings.recovery == "hold":
        u = settings.recovery_input
    elif settings.recovery == "return" and goto.supported(settings.model_name):
        u = _way_home(turn)
    if len(u) != len(settings.input_bounds) or not all(gate.finite(value) for value in u):
        u = (0.0,) * len(settings.input_bounds)
    return tuple(min(max(float(value), low), high) for value, (low, high) in zip(u, settings.input_bounds, strict=True))


def _way_home(turn: Turn) -> tuple[float, ...]:
    """Nothing (stop) at home, and wherever it isn't known where the robot is."""
    settings, state = turn.settings, turn.state
    observation = state.observation
    if state.trouble or observation is None or not 0 <= turn.now - state.observation_ns <= settings.observation_timeout_ns:
        return ()
    if goto.distance(settings.model_name, observation.x, settings.home) <= RETURNED_WITHIN_M:
        return ()
    return goto.go_to(settings.model_name, observation.x, settings.home, settings.input_bounds, goto.Gains())


# ---------------------------------------------------------------- control instants


def observed(turn: Turn, observation: Observation) -> None:
    """An observation came: new, repeated, out of order or unusable."""
    if observation == turn.state.observation or observation.seq == turn.state.seen_seq:
        _repeated(turn, observation)
        return
    trouble = _trouble(turn, observation)
    turn.set(trouble=trouble)
    if trouble == "observation_out_of_order":
        regate(turn)
        return
    if not trouble and turn.state.observation is not None:
        turn.set(report_ns=min(observation.stamp_ns - turn.state.observation.stamp_ns, turn.settings.dt_ns))
    begins = turn.state.asked is None and _due(turn, observation, trouble)
    if not trouble:
        turn.set(observation=observation, observation_ns=turn.now, odd_seq=None)
    turn.set(seen_seq=observation.seq)
    if begins:
        _begin_instant(turn, observation, trouble)
    regate(turn)
    if not turn.state.answered and turn.state.asked is None:
        _answer_instant(turn)


def _trouble(turn: Turn, observation: Observation) -> str:
    """Why the observation is not usable, or empty. Also takes a robot that started anew for what it is."""
    if not _usable(turn, observation):
        return "observation_invalid"
    last = turn.state.observation
    if last is None or (observation.seq > last.seq and observation.stamp_ns > last.stamp_ns):
        return ""
    if turn.settings.lockstep:  # a robot that repeats itself waits there: it is no echo of the past
        restarted = observation.seq == turn.state.odd_seq
    else:
        restarted = turn.now - turn.state.observation_ns > turn.settings.observation_timeout_ns
    if not restarted:
        turn.set(odd_seq=observation.seq)
        return "observation_out_of_order"
    close(turn, "observation_out_of_order")  # another robot, for all that is known: the gate settles anew
    forget_observations(turn)
    return ""


def _usable(turn: Turn, observation: Observation) -> bool:
    return not observation.fault and len(observation.x) == len(turn.settings.states) and all(gate.finite(value) for value in observation.x)


def forget_observations(turn: Turn) -> None:
    """The robot's sequence and stamps begin anew: link lost, clock stepped back, robot restarted. Nobody answers the old ones."""
    if turn.state.asked is not None:
        recover_now(turn)
    turn.set(observation=None, trouble="", seen_seq=None, odd_seq=None, control_seq=None, control_stamp_ns=None, answered=True)
    turn.set(report_ns=0, due_ns=0)


def _due(turn: Turn, observation: Observation, trouble: str) -> bool:
    state, settings, stamp = turn.state, turn.settings, observation.stamp_ns
    last = state.control_stamp_ns
    if last is None or (not trouble and stamp < last):
        return True  # in order, and yet before the last instant: that one's stamp was of an unusable observation, and wrong
    if settings.rules < GRID or (settings.lockstep and 2 * state.report_ns > settings.dt_ns):
        return 10 * (stamp - last) >= 9 * settings.dt_ns
    return 2 * stamp + state.report_ns >= 2 * state.due_ns


def _begin_instant(turn: Turn, observation: Observation, trouble: str) -> None:
    last, stamp = turn.state.control_stamp_ns, observation.stamp_ns
    if trouble and last is not None:
        stamp = min(stamp, last + turn.settings.dt_ns)  # the stamp of an unusable observation may be anything
    turn.set(control_seq=observation.seq, control_stamp_ns=stamp, due_ns=_next_on_grid(turn, stamp), answered=False, repeats=0)


def _next_on_grid(turn: Turn, stamp_ns: int) -> int:
    """The grid point after the one nearest to this instant. The grid begins with the first instant, and anew where the clock went back."""
    last, due, dt = turn.state.control_stamp_ns, turn.state.due_ns, turn.settings.dt_ns
    if last is None or stamp_ns < last:
        return stamp_ns + dt
    return due + dt * (1 + max(0, (2 * (stamp_ns - due) + dt) // (2 * dt)))


def _repeated(turn: Turn, observation: Observation) -> None:
    if not turn.settings.lockstep:
        if not _usable(turn, observation):  # nothing that was seen before, but what a transport makes of what has no number of its own
            turn.set(trouble="observation_invalid")
            regate(turn)
        return
    if observation == turn.state.observation:  # what came in between was a stray; the robot waits here
        turn.set(seen_seq=observation.seq, trouble="")
    if turn.state.asked is None and turn.state.control_seq != observation.seq and _due(turn, observation, turn.state.trouble):
        _begin_instant(turn, observation, turn.state.trouble)
    regate(turn)
    if turn.state.asked is not None or turn.state.control_seq != observation.seq:
        return
    if not turn.state.answered:
        _answer_instant(turn)
        return
    turn.set(repeats=turn.state.repeats + 1)
    if turn.state.repeats >= LOST_AFTER_REPEATS:
        turn.set(repeats=0)
        _send_again(turn, observation.seq)


def _send_again(turn: Turn, obs_seq: int) -> None:
    """The same command, if its source may still drive; the robot's clock stood still, so it is as fresh as it was."""
    sent = turn.state.sent
    if (
        sent is None
        or sent.obs_seq != obs_seq
        or sent.source == "recovery"
        or active(turn) != sent.source
        or not _may_drive(turn, sent.source)
    ):
        _send_recovery(turn, obs_seq)
    else:
        _send(turn, sent.source, sent.u, obs_seq, sent.ttl_ns)


def _may_drive(turn: Turn, source: Source) -> bool:
    if source == "controller":
        return turn.state.gate_open
    return gate.standing(turn.settings, situation(turn.state), source, turn.now) is None


def active(turn: Turn) -> Literal["sampler", "controller"] | None:
    """The source to ask. The controller only while nothing stands against it: else it would be asked in vain."""
    if turn.state.campaign is not None and turn.state.campaign.running:
        return "sampler"
    if turn.state.deployment is not None and turn.state.clear_since_ns is not None:
        return "controller"
    return None


def _answer_instant(turn: Turn) -> None:
    state, settings = turn.state, turn.settings
    obs_seq, source = _instant(turn), active(turn)
    if source == "controller" and _waits_for_gate(turn):
        _send_recovery(turn, obs_seq)
    elif source is not None:
        turn.set(asked=Asked(source, obs_seq, turn.now), idle=0)
        turn.emit(Ask(turn.now, source, obs_seq))
    elif not settings.lockstep:
        _send_recovery(turn, obs_seq)
    elif state.idle < settings.settle_periods:
        _send_recovery(turn, obs_seq)
        arrived = turn.state.sent is None or not any(turn.state.sent.u)
        if arrived or settings.recovery != "return":  # on its way home the robot has not settled
            turn.set(idle=state.idle + 1)


def _waits_for_gate(turn: Turn) -> bool:
    """A scenario of a comparison begins with the gate open, so that the controller drives it from its start."""
    deployment = turn.state.deployment
    if deployment is None or deployment.scenarios is None or deployment.begun:
        return False
    if turn.state.gate_open:
        turn.set(deployment=msgspec.structs.replace(deployment, begun=True))
    return not turn.state.gate_open


def wake(turn: Turn) -> None:
    """Lockstep: an instant that nobody was there to answer still waits, the robot with it; a source that came since is asked."""
    if turn.settings.lockstep and not turn.state.answered and turn.state.asked is None and active(turn) is not None:
        _answer_instant(turn)


# ---------------------------------------------------------------- answers


def proposed(turn: Turn, command: Command) -> None:
    """A source answers, or an outsider commands: the gate decides."""
    asked, source = turn.state.asked, command.source
    if source not in ("controller", "sampler"):
        _decided(turn, command, gate.decide(turn.settings, situation(turn.state), command, turn.now))
        return
    if asked is None or asked.source != source or asked.obs_seq != command.obs_seq:
        _decided(turn, command, gate.Verdict(allow=False, reason="command_out_of_order", margin=gate.NO_NUMBER))
        if source == "controller" and turn.state.gate_open:
            close(turn, "command_out_of_order")
        return
    verdict = gate.decide(turn.settings, situation(turn.state), command, turn.now)
    _decided(turn, command, verdict)
    if not verdict.allow:
        if source == "controller" and verdict.reason != "settling":
            close(turn, verdict.reason)
        if turn.state.asked is not None:
            recover_now(turn)
        if source == "sampler" and verdict.reason in gate.LATCH_HOLDS_ALL:
            latch(turn, verdict.reason)
        return
    if source == "controller":
        _open(turn)
        turn.set(controller_seq=command.seq)
    else:
        turn.set(sampler_seq=command.seq)
    _send(turn, source, tuple(float(value) for value in command.u), asked.obs_seq, min(command.ttl_ns, turn.settings.command_ttl_ns))


def answer_late(turn: Turn, event: AnswerLate) -> None:
    """The controller could not answer in time for a reason of the computer's: the gate closes as for a stale command, and nothing latches
    that the profile does not list. The answer, when it comes, answers nothing any more.
    """
    asked = turn.state.asked
    if asked is None or asked.source != "controller" or asked.obs_seq != event.obs_seq:
        return
    close(turn, "command_stale", event.detail)
    if turn.state.asked is not None:
        recover_now(turn)


def _decided(turn: Turn, command: Command, verdict: gate.Verdict) -> None:
    allow, reason, margin = verdict
    turn.emit(Decided(turn.now, command.source, command.seq, command.obs_seq, allow, reason, margin))


# ---------------------------------------------------------------- time


def overdue(turn: Turn) -> bool:
    """Whether a source was asked so long ago that its answer would be void. The daemon's deadline comes before this."""
    asked = turn.state.asked
    return asked is not None and not turn.settings.lockstep and turn.now - asked.t_ns > turn.settings.command_ttl_ns


def keep_recovering(turn: Turn) -> None:
    """Real time, and the robot isn't seen any more: it may still hear."""
    state, settings = turn.state, turn.settings
    if settings.lockstep or not state.link_up or state.sent is None or state.asked is not None:
        return
    blind = state.trouble or state.observation is None or turn.now - state.observation_ns > settings.observation_timeout_ns
    if blind and turn.now - state.sent.t_ns >= settings.dt_ns:
        _send_recovery(turn, _instant(turn))
