"""Where requests from the control socket become the core's, and its answers go back to whoever asked.

What must be looked at before the core hears of it (a controller's file, a model, a certificate) is looked at here, in
other processes where it could take long.
"""

from __future__ import annotations

import os
import time
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import msgspec

from s2r_runtime.core.state import unix_now
from s2r_runtime.daemon import issuing
from s2r_runtime.daemon.control import Connection, ControlServer
from s2r_runtime.daemon.door import NO_TEXT, Request
from s2r_runtime.daemon.every import Every
from s2r_runtime.daemon.status import status
from s2r_runtime.daemon.worker import Brought, Failed, InputsJob, LoadJob, ModelJob, Result
from s2r_runtime.errors import S2RError, UsageError
from s2r_runtime.messages import Answer, Requested

if TYPE_CHECKING:
    from s2r_runtime.daemon.loop import Daemon

PLAIN = ("undeploy", "revoke", "clear", "stop", "permit", "sample", "cancel", "pause", "trace", "verify")
"""Verbs that the core can have as they are."""
MOVING = ("sample", "deploy", "excite")
"""Verbs that make the robot move. Whoever asked for one and is gone before its answer stops it (`core.leaving`)."""
DETACHED = "it goes on without this command. Look: s2r status; stop: s2r sample PROFILE --pause; stop everything: s2r stop"
STILL = "nothing drives for it; what the daemon still computes goes on: s2r status"
SETTLE_WITHIN_NS = 5_000_000_000
"""Three times the longest that a busy computer let a robot's or a link's process wait."""
LOAD_TIMEOUT_S = 30.0
MODEL_TIMEOUT_S = 60.0
"""A person's own model is run a few times to see that it is one."""
INPUTS_TIMEOUT_S = 120.0
"""The model is rolled out over them, one step after the other: 0.1 ms a row."""
PROGRESS_NS = 200_000_000
RESULT_OF = {"sample": "gap", "trace": "trace", "deploy": "verify", "verify": "verify"}
"""Whose result goes with the answer to a verb."""


class Waiting(NamedTuple):
    """A request without a final answer. connection: whose, None for this process itself or a client that is gone."""

    verb: str
    connection: Connection | None
    detached: bool = False


class Desk:
    """Numbers requests, and remembers who waits for an answer."""

    def __init__(self, daemon: Daemon) -> None:
        self._d = daemon
        self._server: ControlServer | None = None
        self._numbers = 0
        self._waiting: dict[int, Waiting] = {}
        self.answers: dict[int, Answer] = {}  # to requests of this process itself
        self._said = (0, "")
        self._postponed: list[tuple[Requested, int]] = []
        self._told = Every(PROGRESS_NS)

    def open(self, path: Path) -> None:
        """Listens. Raises ConfigError if another daemon does."""
        self._server = ControlServer(path, self._d.selector, self._requested, self._left)
        self._server.open()

    def close(self) -> None:
        """Hangs up."""
        if self._server is not None:
            self._server.close()

    def tick(self, now_ns: int) -> None:
        """Drops silent clients; tells how far a campaign is. now_ns: the host's clock."""
        if self._server is not None:
            self._server.tick(now_ns)
        self._put()
        if self._told.due(now_ns):
            sampling = self._d.sampler.progress()
            if sampling is not None:
                phase, taken, n, rejected, left_s = sampling
                detail = phase + "".join(f", {count} {reason}" for reason, count in sorted(rejected.items()))
                self.progress(taken, n, detail, None if self._d.clock.lockstep else left_s)
            elif (driven := self._d.excitation.progress()) is not None:
                self.progress(driven[1], driven[2], driven[0])

    def progress(self, done: float, total: float, detail: str, left_s: float | None = None) -> None:
        """How far what is being waited for is."""
        for waiting in tuple(self._waiting.values()):  # one that is found gone here makes a request of its own
            if (connection := waiting.connection) is not None:
                connection.progress(done=done, total=total, detail=detail, seconds_left=left_s)

    def note(self, verb: str, text: str) -> None:
        """A line for whoever waits for the answer to this verb."""
        for waiting in tuple(self._waiting.values()):
            if waiting.verb == verb and waiting.connection is not None:
                waiting.connection.progress(text=text)

    def request(
        self, verb: Any, connection: Connection | None = None, *, detached: bool = False, by: int | None = None, **fields: Any
    ) -> int:
        """Puts a request to the core; its number. detached: as in `Request`. by: default the connection's user, or this process's."""
        self._numbers += 1
        number = self._numbers
        self._waiting[number] = Waiting(verb, connection, detached)
        if by is None:
            by = os.getuid() if connection is None else connection.uid
        self._postponed.append((Requested(0, number, verb, by, **fields), time.monotonic_ns() + SETTLE_WITHIN_NS))
        self._put()
        return number

    def _put(self) -> None:
        """Hands requests to the core, in order. One that makes the robot move waits until it is heard, where a busy computer lost it for a
        moment. In lockstep it waits until the robot stands, which takes milliseconds: when it was typed would otherwise decide at which of
        the robot's periods its story begins.
        """
        while self._postponed:
            request, limit_ns = self._postponed[0]
            if request.verb in MOVING and self._settling() and time.monotonic_ns() < limit_ns:
                return
            self._postponed.pop(0)
            self._d.feed(request)
            self._let_go(request.request_id)

    def _let_go(self, number: int) -> None:
        """A detached request drives: its client need not wait."""
        campaign, waiting = self._d.state.campaign, self._waiting.get(number)
        if waiting is None or not waiting.detached or campaign is None or campaign.request_id != number:
            return
        what = f"{campaign.n} rows of inputs are driven"
        if not campaign.inputs:
            what = f"campaign of epoch {campaign.epoch} runs, {campaign.taken} of {campaign.n} samples taken"
        self._waiting[number] = Waiting(waiting.verb, None)
        if waiting.connection is not None:
            waiting.connection.answer(0, f"{what}; {DETACHED}")

    def _left(self, connection: Connection, why: str) -> None:
        """A client is gone, or wants no more of its request: what drives for it alone stops, and nothing begins to."""
        number = next((n for n, waiting in self._waiting.items() if waiting.connection is connection), None)
        if number is None:  # it has no number yet: its file is being read
            connection.answer(1, f"withdrawn before anything moved: {why}")
            return
        verb, _, detached = self._waiting[number]
        postponed = [one for one in self._postponed if one[0].request_id == number]
        if verb in MOVING and postponed:
            self._postponed.remove(postponed[0])
            self._waiting.pop(number)
            connection.answer(1, f"withdrawn before anything moved: {why}")
        elif verb in MOVING and not detached:
            self.request("pause", by=connection.uid, count=number, text=why)
        if connection.listening:  # the core had nothing to stop
            connection.answer(1, f"{verb}: {STILL}")
        if number in self._waiting:
            self._waiting[number] = Waiting(verb, None)

    def _settling(self) -> bool:
        """Nothing drives, and a robot that was there is not heard at this moment; or, in lockstep, it still gets its recovery commands."""
        state = self._d.state
        if state.campaign is not None or state.deployment is not None:
            return False
        heard = state.link_up and state.observation is not None
        return state.answered if heard and self._d.clock.lockstep else not heard and self._d.observation is not None

    def answered(self, answer: Answer) -> None:
        """The core's answer goes to whoever asked."""
        verb, connection, _ = self._waiting.get(answer.request_id, Waiting("", None))
        if not answer.final:
            self._said = (answer.exit_code, answer.text)
            if connection is not None:
                connection.progress(text=answer.text)
            return
        self._waiting.pop(answer.request_id, None)
        if connection is None:
            self.answers[answer.request_id] = answer
        else:
            refused = answer.exit_code and verb == "trace"  # what is there is another trace's
            connection.answer(answer.exit_code, answer.text, None if refused else self.result_of(verb))

    def result_of(self, verb: str) -> Any:
        """The newest result of what the verb asks for, as plain data."""
        if verb == "excite":
            return self._d.excitation.result()
        return msgspec.to_builtins(self._d.actions.results.get(RESULT_OF.get(verb, "")))

    # ------------------------------------------------------------------ the socket

    def _requested(self, connection: Connection, request: Request) -> None:
        try:
            self._serve(connection, request)
        except S2RError as error:
            connection.answer(error.exit_code, str(error))

    def _serve(self, connection: Connection, request: Request) -> None:
        match request.verb:
            case "status":
                found = status(self._d)
                connection.answer(0, f"gate {found['gate']} ({found['reason']})", found)
            case "deploy":
                self._deploy(connection, request)
            case "adopt":
                self._adopt(connection, request)
            case "excite":
                self._excite(connection, request)
            case verb if verb in PLAIN:
                text = "" if verb == "pause" else request.text
                count, detached = (0 if verb == "pause" else request.count), verb == "sample" and request.detached
                self.request(verb, connection, detached=detached, text=text, duration_s=request.duration_s, count=count)
            case verb:
                connection.answer(2, f"{verb}: no such request; there are: status, deploy, adopt, excite, {', '.join(PLAIN)}")

    def _deploy(self, connection: Connection, request: Request) -> None:
        def loaded(result: Result | Failed) -> None:
            if not connection.listening:
                return
            if isinstance(result, Failed) or result.controller is None:
                connection.answer(78, result.text if isinstance(result, Failed) else "no controller was loaded")
                return
            self._d.actions.keep_controller(result.controller)
            digest = result.controller.digest
            if (result.certificate is None or self._install(connection, result.certificate)) and connection.listening:
                self.request("deploy", connection, digest=digest, text=request.path, scenarios=request.scenarios)

        d = self._d
        now = max(int(time.time()), unix_now(d.state))
        job = LoadJob(request.path, request.parameters, request.certificate, d.trust.keys(), d.profile, now)
        d.workshop.start(job, LOAD_TIMEOUT_S, loaded)

    def _install(self, connection: Connection, brought: Brought) -> bool:
        """A certificate that came along. Refused, it ends the request: nobody asked for an attempt of this robot's budget instead."""
        self._numbers += 1
        self._waiting[self._numbers] = Waiting("certificate", connection)
        self._said = (0, "")
        try:
            self._d.feed(issuing.take(self._d, brought, self._numbers))
        except S2RError as error:
            self._said = (error.exit_code, str(error))
        self._waiting.pop(self._numbers)
        if self._said[0]:
            connection.answer(*self._said)
        return not self._said[0]

    def _excite(self, connection: Connection, request: Request) -> None:
        """Given inputs are read and looked through elsewhere; the core says whether they may be driven now."""
        state = self._d.state
        if state.deployment is not None or state.campaign is not None:  # the core says why not; nothing is read while something drives
            self.request("excite", connection, digest="none", count=1)
            return

        def loaded(result: Result | Failed) -> None:
            if not (connection.listening or request.detached):
                return
            if isinstance(result, Failed) or result.inputs is None:
                connection.answer(1, f"refused: {result.text if isinstance(result, Failed) else 'no inputs were read'}")
                return
            given = result.inputs
            self._d.excitation.keep(given)
            self._d.logbook.attach(f"inputs/{given.digest}", "text/csv", given.text.encode())
            self.request("excite", connection, detached=request.detached, digest=given.digest, count=len(given.rows))

        seen = state.observation if not state.trouble else None
        job = InputsJob(request.path, self._d.profile, () if seen is None else seen.x)
        self._d.workshop.start(job, INPUTS_TIMEOUT_S, loaded)

    def _adopt(self, connection: Connection, request: Request) -> None:
        """A worker looks whether the model can take the place of the one in force; the robot's states, inputs and step are the same."""
        d, proposal = self._d, self._d.state.memory.proposal
        named = request.model != NO_TEXT
        if not named and proposal is None:
            raise UsageError("adopt: no model is proposed; name one, or trace first: s2r trace --live campaign")
        profile = d.profile

        def checked(result: Result | Failed) -> None:
            if not connection.listening:
                return
            if isinstance(result, Failed) or result.model is None:
                connection.answer(78, result.text if isinstance(result, Failed) else "adopt: no model was loaded")
                return
            found = result.model
            d.adopting[found.digest] = msgspec.structs.replace(profile, model=found.spec), found.facts
            # before the decision, so that a reader of the log has the model when it comes into force
            d.logbook.attach(f"model/{found.digest}", "application/toml", found.toml.encode())
            self.request("adopt", connection, digest=found.digest)

        digest = "" if named or proposal is None else proposal.digest
        job = ModelJob(profile, d.facts, str(d.models.folder), d.models.base, request.model, request.base, digest)
        d.workshop.start(job, MODEL_TIMEOUT_S, checked)
