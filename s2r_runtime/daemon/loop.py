"""The daemon: wires the robot, the core, the recorder and the helpers together, and turns one loop.

Everything that happens becomes an event, is logged, goes through the core, and what comes out is logged and carried out, in this
order. What decides has no clock and no I/O (`core`); what is here decides nothing. An opening of the gate, a certificate, the memory
and what was spent are on the disk before what follows them takes effect; a closing takes effect first and is logged next.

If something in here breaks, the last act is the recovery command; the exit code is then 70, and the service manager starts anew.
"""

from __future__ import annotations

import contextlib
import gc
import selectors
import sys
import threading
import time
import traceback
from collections import deque
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from pathlib import Path

import msgspec

from s2r_runtime.child import Child
from s2r_runtime.core import reducer as core
from s2r_runtime.core.state import State
from s2r_runtime.daemon import computer, control, issuing, past
from s2r_runtime.daemon.actions import Actions
from s2r_runtime.daemon.awake import LOOK_S, AwakeClock
from s2r_runtime.daemon.console import Console
from s2r_runtime.daemon.desk import Desk
from s2r_runtime.daemon.driver import Driver
from s2r_runtime.daemon.every import Every
from s2r_runtime.daemon.excitation import Excitation
from s2r_runtime.daemon.hang_guard import HangGuard
from s2r_runtime.daemon.heads import Heads
from s2r_runtime.daemon.logbook import Logbook
from s2r_runtime.daemon.model_store import ModelStore
from s2r_runtime.daemon.persistence import StateFolder
from s2r_runtime.daemon.retention import Retention
from s2r_runtime.daemon.robot_link import Clock, link_of
from s2r_runtime.daemon.sampler import Keeper, Sampler
from s2r_runtime.daemon.settings import ModelFacts, disk_timeout_s, settings_of
from s2r_runtime.daemon.stop_signals import StopSignals
from s2r_runtime.daemon.systemd import Notifier, to_journal
from s2r_runtime.daemon.transport_values import Inbound
from s2r_runtime.daemon.trust import Trust
from s2r_runtime.daemon.workshop import Watcher, Workshop
from s2r_runtime.errors import ConfigError
from s2r_runtime.files.printable import printable_lines
from s2r_runtime.messages import (
    AnalyticsChanged,
    Command,
    EpisodeEnded,
    Event,
    Frame,
    LinkChanged,
    Memory,
    Observation,
    ObservationRefused,
    Observed,
    OverrideChanged,
    Proposed,
    RecorderChanged,
    SampleTaken,
    Send,
    Started,
    Stopping,
    Ticked,
    WallClockRead,
)
from s2r_runtime.modelspec import dump_model
from s2r_runtime.plugins import registry
from s2r_runtime.profile import Profile
from s2r_runtime.trust import keys

TICK_NS = 20_000_000
SHARE_NS = 5_000_000
"""Of a turn of the loop for what the robot's side sent, a quarter of a tick; the rest comes with the next turn, at once."""
ROUND_NS = 100_000_000
WALL_CLOCK_NS = 1_000_000_000
MEASURED_S = 1.0
"""For so long the computer is tried at the start: some 150 wake-ups and seven syncs."""
PRUNE_NS = 60_000_000_000
"""Between two looks whether old logs are to be deleted."""
NEW_LOG_NS = 1_000_000_000
"""Between two looks whether a new log can begin after the old one lost a message."""


class Daemon:
    """One robot's daemon. `run` returns the exit code; everything else is for the parts of the daemon.

    state_dir: counters, certificates, key (default: the user's state folder, by robot). key_path: signing key (default: one in the state
    folder, made when there is none). log_dir: default as the profile says. log_file: one log of this name instead. listen: whether
    there is a control socket. on_tick: called with every tick, for whoever runs a daemon in his own process. analytics: that process,
    if it was started before this module was loaded. simulated_seeds: of a simulation that is to be repeatable, instead of entropy.
    """

    def __init__(
        self,
        profile: Profile,
        *,
        profile_path: Path,
        state_dir: Path | None = None,
        key_path: Path | None = None,
        log_dir: Path | None = None,
        log_file: Path | None = None,
        seed: int | None = None,
        listen: bool = True,
        on_tick: Callable[[Daemon], None] | None = None,
        analytics: Child | None = None,
        simulated_seeds: Iterator[int] | None = None,
    ) -> None:
        self.profile, self._profile_path, self.seed = profile, profile_path, seed
        self.state_dir = state_dir or control.state_root() / profile.robot.name
        self._key_path, self._log_file, self._listen, self._on_tick = key_path, log_file, listen, on_tick
        self._analytics, self.simulated_seeds = analytics, simulated_seeds
        self._log_dir = log_file.parent if log_file else log_dir or self.state_dir / profile.recording.directory
        self.selector = selectors.DefaultSelector()
        self.clock = Clock(lockstep=profile.clock == "lockstep")
        self.awake = AwakeClock()
        self.notifier = Notifier()
        self.state: State = core.initial()
        self.memory: Memory
        self.observation: Observation | None = None
        self.adopting: dict[str, tuple[Profile, ModelFacts]] = {}
        self.began_ns = time.monotonic_ns()
        self._queue: deque[Event] = deque()
        self._draining = False
        self._last_ns = 0
        self._numbers = 0
        self._recorder_ok, self._log_late = True, False
        self._next_tick_ns = 0
        self._round, self._wall_clock, self._new_log, self._prune = map(Every, (ROUND_NS, WALL_CLOCK_NS, NEW_LOG_NS, PRUNE_NS))
        self._heads = Heads(self.say if to_journal() else lambda _: None)
        self._console = Console(self.say if log_file is None else lambda _: None)  # else whoever runs it in this process speaks
        self._log_closed = False
        self._ended = ""

    # ------------------------------------------------------------------ life

    def run(self) -> int:
        """Serves until SIGTERM or SIGINT (0), or until `end`. Raises ConfigError for what makes a start impossible."""
        with ExitStack() as stack:
            self._open(stack)
            gc.collect()
            gc.freeze()  # what is there now stays: collections while a robot is driven have little to look at
            try:
                self._turn()
                self._finish()
            except Exception:  # noqa: BLE001 - a defect of ours: the robot first, then the report
                self._last_act()
                self.say(traceback.format_exc())
                return 70
        return 0

    def end(self, why: str) -> None:
        """The loop ends with this turn."""
        self._ended = self._ended or why

    def say(self, text: str) -> None:
        """A line for the journal, if anybody takes it: stderr may be a file on the disk that is full."""
        with contextlib.suppress(OSError):
            sys.stderr.write(f"s2r: {printable_lines(text)}\n")
            sys.stderr.flush()

    def _open(self, stack: ExitStack) -> None:
        """What takes long comes first and goes on beside the rest: analytics loads the model while the transport is loaded here."""
        stack.callback(self.selector.close)
        stack.callback(self.notifier.close)
        self._signals = stack.enter_context(StopSignals(self.selector))
        self.guard = stack.enter_context(HangGuard(self.say))
        taken = self._open_state(stack)
        self._start_helpers(stack)
        self._open_log(stack)
        self._set_up_sources(stack, taken)
        self.actions = Actions(self)
        stack.callback(self.actions.close)
        self._open_desk(stack)
        self._open_link()
        newest = self.memory.refused_campaign or self.memory.gap
        if newest is not None:
            self.sampler.recall(newest.epoch)
        self._begin_run()
        threading.Thread(target=self._say_what_is_not_held, name="computer", daemon=True).start()
        self.notifier.ready("waiting for the robot")
        self.say(f"robot {self.profile.robot.name!r}: log {self.logbook.paths[-1]}, state {self.folder.path}")

    def _say_what_is_not_held(self) -> None:
        """In a thread of its own: what this computer cannot hold of the profile, as it is at the start."""
        ability = computer.measure(self._log_dir, MEASURED_S)
        gate, recording, machine = self.profile.gate, self.profile.recording, self.profile.machine
        lacking = computer.not_held(ability, gate, recording, machine, realtime=not self.clock.lockstep)
        for line in lacking or [f"it {ability}: it holds the profile's times"]:
            self.say(f"this computer: {line}")

    def _open_state(self, stack: ExitStack) -> list[SampleTaken]:
        """Memory, key, trust, and the model in force. Returns the samples of an unfinished campaign that were logged."""
        robot = self.profile.robot.name
        self.folder = stack.enter_context(StateFolder(self.state_dir, robot))
        self.memory = self.folder.memory(self._log_dir.glob(f"{robot}-*.mcap") if self._log_file is None else ())
        self.key = issuing.signing_key(self._key_path, self.folder.path, self.say)
        former = keys.former(self._key_path or self.folder.path / "key.pem")
        self.trust = Trust(self.folder.path, keys.public_bytes(self.key), former, simulated=self.simulated_seeds is not None)
        self.trust.check_own()
        self.memory, taken = self._held_against_the_logs(self.memory)
        self.models = ModelStore(self.folder.path, self.profile.model.digest())
        self.profile = self.models.in_force(self.profile, self.memory)
        return taken

    def _start_helpers(self, stack: ExitStack) -> None:
        """Analytics now, a worker when there is work."""
        self.watcher = Watcher(self.selector, self.profile, str(self._profile_path), self.feed, self._analytics, self.awake.now_ns)
        stack.callback(self.watcher.close)
        for plugin in registry().loaded:
            if plugin.error:
                part = "in part " if plugin.offers else ""
                self.say(f"plug-in {plugin.name!r} of {plugin.distribution} {part}not in use: {plugin.error}")
        registry().get("transports", str(self.profile.transport.get("name")))  # loaded here, while analytics loads the model
        self.workshop = Workshop(self.selector)
        stack.callback(self.workshop.close)

    def _open_log(self, stack: ExitStack) -> None:
        """The log, and the link whose frames it records. What the model is made of is known from here on."""
        robot, kept, lockstep = self.profile.robot.name, self.profile.recording, self.clock.lockstep
        self.retention = None
        if self._log_file is None:
            self.retention = Retention(self._log_dir, self.folder.path, robot, kept.keep_bytes, kept.keep_days, self.say)
        self.logbook = Logbook(
            self._log_dir,
            robot,
            kept,
            self.key,
            lockstep=lockstep,
            file=self._log_file,
            number=self._log_number,
            retention=self.retention,
            disk_timeout_s=disk_timeout_s(self.profile),
            clock=self.awake.now_s,
        )
        self.facts: ModelFacts = self.watcher.facts()
        self.settings = settings_of(self.profile, self.profile.model, self.facts, self.seed, simulated=self.simulated_seeds is not None)
        self.link = link_of(self.profile, self.facts, self._record_frame, self.guard)
        self.logbook.begin(self._profile_path, self.profile.model, self.profile.files)
        self._recall_proposal()
        stack.callback(self._close_log)
        stack.callback(self._close_link)

    def _set_up_sources(self, stack: ExitStack, taken: list[SampleTaken]) -> None:
        """Who may be asked what to do: the sampler, given inputs, a controller. taken: samples of an unfinished campaign."""
        self.keeper = Keeper(self.folder, self.logbook.settled, self.say)
        stack.callback(self.keeper.close)
        sampling, logs = self.profile.sampling, lambda: tuple(map(str, self.logbook.paths))
        self.sampler = Sampler(self.folder, self.keeper, sampling, logs, self.next_seq, taken)
        self.excitation = Excitation()
        self.driver = Driver(self.selector, self.profile, lambda: self.settings, self.feed, self.clock.now, self.next_seq, self.awake)
        stack.callback(self.driver.stop)

    def _open_desk(self, stack: ExitStack) -> None:
        """Where people ask; a socket, unless only this process does."""
        self.desk = Desk(self)
        if self._listen:
            self.desk.open(control.socket_dir() / f"{self.profile.robot.name}.sock")
            stack.callback(self.desk.close)

    def _held_against_the_logs(self, memory: Memory) -> tuple[Memory, list[SampleTaken]]:
        """The memory to start with, and the samples of its unfinished campaign that were logged."""
        folder = self._log_dir if self._log_file is None else self.state_dir / self.profile.recording.directory
        keys = self.trust.log_keys()
        logs = past.Logs(folder, memory.robot, keys)
        memory = past.reconciled(memory, logs, keys, self.say)
        self._log_number = logs.next_number
        if not memory.campaign_epoch:
            return memory, []
        paths = past.campaign_logs(logs, memory.robot, memory.campaign_epoch)
        with contextlib.suppress(ConfigError):  # said when the campaign is to go on
            paths += map(Path, (self.folder.campaign() or {}).get("logs", ()))
        return memory, past.samples(dict.fromkeys(paths), memory.campaign_epoch, keys)

    def _recall_proposal(self) -> None:
        """A model that waits to be adopted belongs into this log too. One that is not there any more, or not this profile's, can't be."""
        proposal = self.memory.proposal
        if proposal is None:
            return
        try:
            spec = self.models.load(proposal.digest)
        except ConfigError as error:
            self.say(str(error))
            spec = None
        if spec is None:
            self.say(f"the proposed model {proposal.digest} is not there any more; trace again")
            self.memory = msgspec.structs.replace(self.memory, proposal=None)
        else:
            self.logbook.attach(f"model/{proposal.digest}", "application/toml", dump_model(spec).encode())

    def _open_link(self) -> None:
        self.link.open()
        if not self.link.out_of_use:
            try:
                self.selector.register(self.link, selectors.EVENT_READ, self._robot_ready)
            except (ValueError, KeyError, OSError) as error:
                self.link.refuse("fileno", error)

    def _leave_link(self) -> None:
        with contextlib.suppress(KeyError, ValueError):  # it did not get that far
            self.selector.unregister(self.link)

    def _close_link(self) -> None:
        self._leave_link()
        self.link.close()

    def _begin_run(self) -> None:
        """First events of a log, and what the core cannot know of from before."""
        self.state = core.initial()
        self.feed(Started(0, int(time.time()), self.settings, self.memory))
        self.feed(*self.trust.look(self.state.memory))
        if not self.watcher.up:
            self.feed(AnalyticsChanged(0, up=False, detail="still down"))

    # ------------------------------------------------------------------ the loop

    def _turn(self) -> None:
        while not (self._signals.name or self._ended):
            due_ns = self._next_tick_ns if self.driver.due_ns is None else min(self._next_tick_ns, self.driver.due_ns)
            waits = self.link.waits
            ready = self.selector.select(0 if waits else max(0, due_ns - time.monotonic_ns()) * 1e-9)
            self.awake.look()
            for key, mask in ready:
                waits = waits and key.fileobj is not self.link
                key.data(mask)
            if waits:
                self._robot_ready()
            now_ns = time.monotonic_ns()
            if now_ns >= due_ns:
                self._tick(now_ns)

    def _tick(self, now_ns: int) -> None:
        """What time alone brings. now_ns: the host's clock."""
        self._next_tick_ns = now_ns + TICK_NS
        for change in self.link.poll(now_ns):
            self.feed(change)
        for line in self.link.lines():
            self.say(line)
        if self.link.out_of_use:
            self._leave_link()
        self.driver.poll(now_ns)
        self.watcher.tick(now_ns)
        if self._round.due(now_ns):
            self._go_round(now_ns)
        self.feed(Ticked(0))
        if self._on_tick is not None:
            self._on_tick(self)

    def _go_round(self, now_ns: int) -> None:
        """What need not be looked at every 20 ms."""
        self.workshop.tick(now_ns)
        self._look_at_log(now_ns)
        self.actions.tick(now_ns)
        if self._wall_clock.due(now_ns):
            self._read_wall_clock()
            self.feed(*self.trust.look(self.state.memory))
        self.desk.tick(now_ns)
        self.notifier.alive(now_ns)
        self._heads.tick(now_ns, self.logbook.anchor(), self.link.anchor)
        self._retain(now_ns)
        self.notifier.status(f"gate {'open' if self.state.gate_open else 'closed'} ({self.state.gate_reason})")

    def _read_wall_clock(self) -> None:
        """For expiry; a clock that is behind the latest time is reported once."""
        behind = self.state.clock_behind_s
        self.feed(WallClockRead(0, int(time.time())))
        if self.state.clock_behind_s and not behind:
            self.say(
                f"the wall clock is {self.state.clock_behind_s} s behind the latest time that was seen; certificates expire by that time: "
                "set the clock, or, if it was ahead then by mistake: s2r clear wall_clock"
            )

    def _robot_ready(self, _mask: int = 0) -> None:
        """What came from the robot's side, for SHARE_NS: commands, ticks and people get their turn in between."""
        if self.clock.lockstep and self._recorder_ok and self.logbook.behind:
            self._wait_for_log()
        for arrival_ns, message in self.link.receive(time.monotonic_ns() + SHARE_NS):
            self._from_robot(arrival_ns, message)

    def _wait_for_log(self) -> None:
        """Lockstep: the robot waits while the disk is slow, so that a crash loses no more of what it did, and the gate stays as it is."""
        until_s = time.monotonic() + disk_timeout_s(self.profile)
        while not (self.logbook.caught_up(LOOK_S) or self.logbook.faulty or self._signals.name) and time.monotonic() < until_s:
            self.awake.look()
            self.notifier.alive(time.monotonic_ns())

    def _from_robot(self, arrival_ns: int, message: Inbound) -> None:
        if isinstance(message, Observation):
            self.clock.seen(message)
            self.observation = message
            self.watcher.observed(message)
            self.feed(Observed(self.clock.now() if self.clock.lockstep else arrival_ns, message))
            if self.clock.lockstep:
                self.watcher.wait()
        elif isinstance(message, Command):
            self.feed(Proposed(0, msgspec.structs.replace(message, source="external")))
        else:
            self.feed(message)

    # ------------------------------------------------------------------ events

    def feed(self, *events: Event) -> None:
        """Takes events in; when this returns they are carried out, unless it was called while others are. An event whose t_ns is 0
        is given the time now; no event is earlier than the one before.
        """
        self._queue.extend(events)
        if self._draining:
            return
        self._draining = True
        try:
            while self._queue:
                self._handle(self._queue.popleft())
        finally:
            self._draining = False

    def feed_first(self, event: Event) -> None:
        """As `feed`, before all that wait."""
        self._queue.appendleft(event)
        self.feed()

    def use_model(self, digest: str) -> None:
        """A model was adopted: everything that is started from here on uses it."""
        profile, facts = self.adopting.pop(digest, (None, None))
        if profile is None:  # the profile's own decision for a proposed one
            spec = self.models.load(digest)
            if spec is None:
                raise RuntimeError(f"the adopted model {digest} is not in {self.models.folder}")
            profile = msgspec.structs.replace(self.profile, model=spec)
        self.profile = profile
        self.facts = facts or msgspec.structs.replace(self.facts, any_step=False)  # until a restart: the stricter tolerance is never wrong
        self.settings = settings_of(profile, profile.model, self.facts, self.seed, simulated=self.simulated_seeds is not None)
        self.driver.use(profile)
        self.watcher.use(profile)

    def next_seq(self) -> int:
        """Number of the next proposed command, whoever proposes it."""
        self._numbers += 1
        return self._numbers

    def _handle(self, event: Event) -> None:
        t_ns = event.t_ns
        if isinstance(event, LinkChanged | OverrideChanged | ObservationRefused):
            t_ns = 0  # a transport's stamps are the host's
        elif isinstance(event, EpisodeEnded):
            self.actions.episodes.append(event)
        self._last_ns = max(self._last_ns, t_ns or self.clock.now())
        if event.t_ns != self._last_ns:
            event = msgspec.structs.replace(event, t_ns=self._last_ns)
        self.logbook.put(event, self._last_ns)
        if isinstance(event, LinkChanged):
            self.watcher.restarted()
            self.sampler.restarted()
        self.state, outputs = core.handle(self.state, event)
        self.actions.carry_out(outputs)
        self._console.happened(event)
        self._console.decided(outputs, self.state)

    def _record_frame(self, frame: Frame) -> None:
        self.logbook.put(frame, self._last_ns)

    # ------------------------------------------------------------------ the log

    def _look_at_log(self, now_ns: int) -> None:
        """Says when the log fails or works again; begins a new one, and with it a new run, when the old one is at its end."""
        health = self.logbook.health()
        other = self.actions.unsaved or self.trust.trouble
        ok, late = health.ok and not other, health.late and not other
        if (ok, late) != (self._recorder_ok, self._log_late):
            self.log_changed(ok, other or health.detail, late=late)
        if self.logbook.faulty and self._new_log.due(now_ns) and self.logbook.prepare():
            self._run_anew()

    def _run_anew(self) -> None:
        """A new run in a new log. What a transport says depends on all that it heard before, so it begins anew as well: the log alone
        must say what its frames meant.
        """
        self._end_sources("the log failed")
        self._close_link()
        self.link = link_of(self.profile, self.facts, self._record_frame, self.guard)
        self.logbook.switch()
        self.say(f"a new log begins: {self.logbook.paths[-1]}")
        self.memory, self._recorder_ok, self._log_late, self.observation = self.state.memory, True, False, None
        self._begin_run()
        self._open_link()

    def _retain(self, now_ns: int) -> None:
        """Deletes old logs, if the profile says so and nothing valid rests on them."""
        if self.retention is None:
            return
        self._log_deleted()
        if self._prune.due(now_ns):
            self.retention.prune_beside(lambda: self.state.memory)

    def _log_deleted(self) -> None:
        """What was deleted stands in the log."""
        for gone in () if self.retention is None else self.retention.deleted():
            self.logbook.put(msgspec.structs.replace(gone, t_ns=self._last_ns), self._last_ns)

    def log_changed(self, ok: bool, detail: str, *, late: bool = False) -> None:
        """The recorder failed, or works again. late: it only waits for the disk."""
        self._recorder_ok, self._log_late = ok, late
        self.say("log and state can be relied on again" if ok else f"log or state cannot be relied on: {detail}")
        self.feed_first(RecorderChanged(0, ok, detail, late))

    def _end_sources(self, why: str) -> None:
        self.feed(*self.sampler.stop(0, why), *self.excitation.stop(0, why))
        self.feed(Stopping(0, why))
        self.driver.stop()
        self.watcher.end()
        self.workshop.close()

    # ------------------------------------------------------------------ the end

    def _finish(self) -> None:
        """An orderly end: the recovery command is out and the memory is kept before anything is closed."""
        self.notifier.stopping()
        self._end_sources(self._signals.name or self._ended)
        self._log_deleted()
        self._close_log()
        if (anchor := self.logbook.anchor()) is not None:
            self.link.anchor(anchor)

    def _last_act(self) -> None:
        """Something here broke. Nothing is asked any more, nothing decided: the robot is told to recover, as its profile says."""
        with contextlib.suppress(Exception):
            held = self.settings.recovery_input if self.settings.recovery == "hold" else (0.0,) * len(self.facts.inputs)
            number = self.actions.last_sent + 1
            seen = self.observation.seq if self.observation is not None else -1
            for _ in self.link.send(Send(self._last_ns, number, "recovery", held, seen, self.settings.command_ttl_ns)):
                pass
        with contextlib.suppress(Exception):
            self.driver.stop()

    def _close_log(self) -> None:
        if self._log_closed:
            return
        self._log_closed = True
        health, head = self.logbook.close()
        if not health.ok:
            self.say(f"the log lacks {health.unrecorded} messages: {health.detail}")
        self.say(f"log {self.logbook.paths[-1]} ends at {head}")
