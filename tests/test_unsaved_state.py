"""What rests on the saved state is not done while the disk refuses it, and everything goes on when there is room."""

from __future__ import annotations

import errno
from collections import deque
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import core_rig
import msgspec
import pytest

from s2r_runtime.daemon import persistence
from s2r_runtime.daemon.actions import Actions
from s2r_runtime.daemon.persistence import StateFolder
from s2r_runtime.messages import Answer, IssueCertificate, Memory, RecorderChanged, StartCampaign, StartController, StartJob

ORDERS = StartJob, StartCampaign, StartController, IssueCertificate


class Bench:
    """The real core, the real actions and a real state folder; what moves a robot or costs time is only noted in `done`."""

    def __init__(self, folder: StateFolder, memory: Memory) -> None:
        self.rig = core_rig.Rig(memory)
        self.rig.draws = False  # the actions do
        self.done: list[Any] = []
        self.log_takes_it = True
        self.queue: deque[Any] = deque()
        health = SimpleNamespace(detail="", ok=True)
        daemon: Any = SimpleNamespace(
            folder=folder,
            feed=lambda *events: self.queue.extend(events),
            log_changed=lambda ok, detail: self.queue.appendleft(RecorderChanged(0, ok, detail)),
            logbook=SimpleNamespace(put=lambda *_: None, durable=lambda: self.log_takes_it, health=lambda: health),
            link=SimpleNamespace(inform=lambda _: None, send=lambda _: []),
            watcher=SimpleNamespace(sent=lambda _: None),
            sampler=SimpleNamespace(running=False, stop=lambda *_: []),
            excitation=SimpleNamespace(running=False, stop=lambda *_: []),
            desk=SimpleNamespace(answered=self.done.append),
            simulated_seeds=None,
        )
        self.actions = Actions(daemon)
        self.actions._do |= dict.fromkeys(ORDERS, self.done.append)

    def carry_out(self, outputs: list[Any]) -> list[Any]:
        """What was done of these, and of all that followed from it."""
        self.done.clear()
        self.actions.carry_out(outputs)
        while self.queue:
            event = msgspec.structs.replace(self.queue.popleft(), t_ns=self.rig.t)
            self.actions.carry_out(self.rig.feed(event))
        return list(self.done)

    def room(self) -> None:
        """There is room again; the daemon looks, as it does every 100 ms."""
        self.actions.tick(1 << 62)
        assert not self.actions.unsaved
        self.carry_out(self.rig.feed(RecorderChanged(self.rig.t, ok=True)))


@pytest.fixture
def folder(tmp_path: Path) -> Iterator[StateFolder]:
    with StateFolder(tmp_path / "r", "r") as opened:
        opened.save(core_rig.memory(certificates=()))
        yield opened


@pytest.fixture
def full(monkeypatch: pytest.MonkeyPatch) -> Iterator[pytest.MonkeyPatch]:
    """The disk of the state is full until `undo`."""

    def replace(*_: object) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    with monkeypatch.context() as patch:
        patch.setattr(persistence, "replace", replace)
        yield patch


def started(done: list[Any]) -> list[Any]:
    return [one for one in done if isinstance(one, ORDERS)]


def refusals(done: list[Any]) -> str:
    return " ".join(one.text for one in done if isinstance(one, Answer) and one.exit_code)


def test_an_attempt_that_could_not_be_paid_for_does_not_begin(folder: StateFolder, full: pytest.MonkeyPatch) -> None:
    bench = Bench(folder, core_rig.memory(certificates=()))
    bench.rig.observe()
    done = bench.carry_out(bench.rig.request("deploy", digest="controller"))
    assert started(done) == []
    assert "the state cannot be saved: No space left on device" in refusals(done)
    assert (bench.rig.state.recorder_ok, bench.rig.state.gate_open) == (False, False)
    assert folder.memory().attempts == 1, "the old state is whole"
    for verb in ("deploy", "verify"):
        done = bench.carry_out(bench.rig.request(verb, digest="controller"))
        assert started(done) == []
        assert refusals(done)
    full.undo()
    bench.room()
    spent = folder.memory().attempts
    assert spent > 1, "what was spent on nothing stays spent"
    (order,) = started(bench.carry_out(bench.rig.request("deploy", digest="controller")))
    assert (order.attempt, folder.memory().attempts) == (spent + 1, spent + 1)


def test_a_campaign_does_not_begin_on_a_state_that_is_not_saved(folder: StateFolder, full: pytest.MonkeyPatch) -> None:
    bench = Bench(folder, core_rig.memory(certificates=()))
    bench.rig.observe()
    bench.carry_out(bench.rig.request("permit", duration_s=60.0))
    done = bench.carry_out(bench.rig.request("sample"))
    assert started(done) == []
    assert refusals(done)
    done = bench.carry_out(bench.rig.request("sample"))
    assert started(done) == []
    assert "recorder_down" in refusals(done)
    full.undo()
    bench.room()
    bench.rig.observe()
    assert [type(one) for one in started(bench.carry_out(bench.rig.request("sample")))] == [StartCampaign]


def test_no_certificate_is_issued_and_no_controller_started_while_the_state_is_unsaved(
    folder: StateFolder, monkeypatch: pytest.MonkeyPatch
) -> None:
    def replace(*_: object) -> None:
        raise OSError(errno.EROFS, "Read-only file system")

    bench = Bench(folder, core_rig.memory(certificates=()))
    bench.rig.observe()
    assert started(bench.carry_out(bench.rig.request("deploy", digest="controller")))
    with monkeypatch.context() as patch:
        patch.setattr(persistence, "replace", replace)
        bench.carry_out(bench.rig.request("stop"))
        assert bench.rig.state.memory.latched == ("emergency_stop",)
        assert bench.actions.unsaved
        assert started(bench.carry_out(bench.rig.verified())) == []
    bench.room()
    assert folder.memory().latched == ("emergency_stop",)


def test_each_order_is_refused_while_the_state_is_unsaved_whichever_event_it_belongs_to(folder: StateFolder) -> None:
    bench = Bench(folder, core_rig.memory(certificates=()))
    bench.rig.draws = True
    bench.rig.observe()
    outputs = [one for one in bench.rig.request("deploy", digest="controller") if isinstance(one, StartJob)]
    bench.actions.unsaved = "the state cannot be saved: as an earlier event found"
    assert started(bench.carry_out(outputs)) == []
    bench.actions.unsaved = ""
    assert started(bench.carry_out(outputs)) == outputs
