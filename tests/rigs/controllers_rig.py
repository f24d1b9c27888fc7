"""A hosted controller for tests."""

from __future__ import annotations

import contextlib
import select
import time
from collections.abc import Iterator

from s2r_runtime.controllers.hosted import ControllerFile, HostedController, Late, Ready, Reply, Stopped
from s2r_runtime.messages import Observation, Scenarios
from s2r_runtime.modelspec import ModelSpec
from s2r_runtime.profile import TaskChoice

MODEL = ModelSpec("unicycle", 0.033)

PATIENT_NS = 20_000_000_000
"""A deadline for those that answer: far above what a busy machine takes."""


class Hosted:
    """A hosted controller and a loop like the daemon's."""

    def __init__(
        self,
        file: ControllerFile,
        task: TaskChoice | None = None,
        start_timeout_s: float = 60.0,
        patience_s: float = 0.0,
        memory_bytes: int = 1 << 28,
    ) -> None:
        self.host = HostedController(
            file,
            model=MODEL,
            nx=3,
            nu=2,
            task=task,
            scenarios=Scenarios(7, 0, 0 if task is None else task.episodes),
            memory_bytes=memory_bytes,
            start_timeout_s=start_timeout_s,
            patience_s=patience_s,
        )
        self.host.start()
        self.seq = 0

    def next(self) -> Ready | Reply | Late | Stopped:
        """The next event, however long it takes: the deadlines are the controller's."""
        while True:
            due = self.host.deadline_ns
            left_s = 0.02 if due is None else min(0.02, max(0.0, (due - time.monotonic_ns()) / 1e9))
            select.select([self.host], [], [], left_s)
            if events := self.host.poll(time.monotonic_ns()):
                assert len(events) == 1
                return events[0]

    def ask(self, x: tuple[float, ...] = (0.5, 0.25, 0.0), deadline_ns: int = PATIENT_NS) -> Ready | Reply | Late | Stopped:
        self.seq += 1
        self.host.ask(Observation(self.seq, 0, x), time.monotonic_ns() + deadline_ns)
        return self.next()


@contextlib.contextmanager
def hosted(file: ControllerFile, task: TaskChoice | None = None, patience_s: float = 0.0) -> Iterator[Hosted]:
    """Started and ready."""
    it = Hosted(file, task, patience_s=patience_s)
    try:
        ready = it.next()
        assert isinstance(ready, Ready), ready
        assert ready.digest == file.digest
        yield it
    finally:
        it.host.close()
