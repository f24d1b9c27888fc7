"""Drives given inputs inside the daemon: row after row, one for each observation that the sampler is asked about."""

from __future__ import annotations

from typing import Any

from s2r_runtime.daemon.given_inputs import GivenInputs
from s2r_runtime.messages import Command, Event, InputsFinished, Observation, Proposed, Settings, SourceStarted, SourceStopped, StartInputs

NO_STATEMENT = (
    "No statement: these inputs were chosen, not drawn, so the transitions are no independent samples and bound no other. "
    "What they are for is s2r trace."
)


class Excitation:
    """The source `sampler` while inputs are given. Every method returns the events that came of it, in order."""

    def __init__(self) -> None:
        self._loaded: dict[str, GivenInputs] = {}
        self._driven: GivenInputs | None = None
        self._row = 0
        self._ttl_ns = 0
        self._result: dict[str, Any] | None = None

    def keep(self, inputs: GivenInputs) -> None:
        """They were read, and may be driven; only the newest."""
        self._loaded = {inputs.digest: inputs}
        self._result = None

    @property
    def running(self) -> bool:
        """Whether rows are being driven."""
        return self._driven is not None

    def start(self, order: StartInputs, settings: Settings) -> list[Event]:
        """Begins at the first row."""
        inputs = self._loaded.get(order.digest)
        if inputs is None or len(inputs.rows) != order.n:
            return [SourceStopped(order.t_ns, "sampler", "start_failed", "their file is not loaded; ask again")]
        self._driven, self._row, self._ttl_ns = inputs, 0, settings.command_ttl_ns
        return [SourceStarted(order.t_ns, "sampler", inputs.digest)]

    def ask(self, t_ns: int, observation: Observation, seq: int) -> list[Event]:
        """The next row; the end, one period after the last. seq: of the command."""
        inputs = self._driven
        if inputs is None:
            return []
        if self._row == len(inputs.rows):
            return self._end(t_ns, "finished", "")
        u = inputs.rows[self._row]
        self._row += 1
        return [Proposed(t_ns, Command(seq, t_ns, "sampler", u, observation.seq, self._ttl_ns))]

    def stop(self, t_ns: int, detail: str) -> list[Event]:
        """Ends before the last row."""
        return self._end(t_ns, "stopped", detail) if self.running else []

    def progress(self) -> tuple[str, int, int] | None:
        """(what, rows given out, of how many) while they are driven."""
        return None if self._driven is None else ("inputs", self._row, len(self._driven.rows))

    def result(self) -> dict[str, Any] | None:
        """Of the newest: plain data."""
        return self._result

    def _end(self, t_ns: int, reason: Any, detail: str) -> list[Event]:
        inputs, self._driven = self._driven, None
        assert inputs is not None  # noqa: S101 - callers checked
        complete = reason == "finished"
        rows = self._row
        self._result = {
            "digest": inputs.digest,
            "rows": rows,
            "of": len(inputs.rows),
            "complete": complete,
            "independent": False,
            "statement": NO_STATEMENT,
        }
        return [SourceStopped(t_ns, "sampler", reason, detail), InputsFinished(t_ns, inputs.digest, rows, complete, detail)]
