"""One sampling campaign without a running daemon: the same daemon in this process, for as long as the campaign takes.

Whoever calls this gives the permit. State, counters and gap are the robot's own, as ever: a campaign that is interrupted goes on with
the next call, in another log that holds the earlier samples too.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import msgspec

from s2r_runtime.core.gaps import RETRY
from s2r_runtime.daemon.loop import Daemon
from s2r_runtime.errors import UsageError
from s2r_runtime.files.durable import read, unseal
from s2r_runtime.messages import Memory
from s2r_runtime.profile import Profile

ROBOT_WITHIN_S = 15.0
"""Discovery on a network takes a second or two; a robot that is silent for longer is not there."""
SILENT_S = 60.0
"""A robot that was there and is not heard for so long went away for good: its campaign is kept, and whoever waits for it is told."""

Progress = Callable[..., None]


class _Script:
    """What a person would do: wait for the robot, give the permit, ask for the campaign, wait for its end."""

    def __init__(self, n: int, permit_s: float, progress: Progress | None, left: Callable[[], str] | None, text: str) -> None:
        self._text, self._n, self._permit_s, self._progress, self._left = text, n, permit_s, progress, left
        self._began = self._heard = time.monotonic()
        self._number = 0
        self.exit_code, self.text = 1, ""

    def __call__(self, daemon: Daemon) -> None:
        """Called with every tick of the daemon's loop."""
        if self._left is not None and (why := self._left()):
            daemon.end(why)
        elif not self._number:
            self._begin(daemon)
        elif (answer := daemon.desk.answers.get(self._number)) is not None:
            self.exit_code, self.text = answer.exit_code, answer.text
            daemon.end("the campaign is over")
        elif self._silent(daemon):
            taken, n = len(daemon.sampler.samples), daemon.sampler.n
            self.exit_code = 3
            self.text = f"the robot was not heard for {SILENT_S:g} s, after {taken} of {n} samples; the same command goes on with it"
            daemon.end(self.text)
        elif self._progress is not None and (sampling := daemon.sampler.progress()) is not None:
            phase, taken, n, rejected, left_s = sampling
            detail = phase + "".join(f", {count} {reason}" for reason, count in sorted(rejected.items()))
            self._progress(taken, n, detail, None if daemon.clock.lockstep else left_s)

    def _silent(self, daemon: Daemon) -> bool:
        if daemon.state.link_up:
            self._heard = time.monotonic()
        return time.monotonic() - self._heard > SILENT_S

    def _begin(self, daemon: Daemon) -> None:
        if daemon.state.link_up and daemon.state.observation is not None:
            daemon.desk.request("permit", duration_s=self._permit_s)
            self._number = daemon.desk.request("sample", count=self._n, text=self._text)
        elif time.monotonic() - self._began > ROBOT_WITHIN_S:
            self.exit_code, self.text = 3, f"the robot does not answer: no usable observation within {ROBOT_WITHIN_S:g} s"
            daemon.end(self.text)


def run_campaign(
    profile: Profile,
    profile_path: Path,
    out: Path,
    *,
    n: int = 0,
    permit_s: float = 3600.0,
    state_dir: Path | None = None,
    seed: int | None = None,
    progress: Progress | None = None,
    left: Callable[[], str] | None = None,
    retry: bool = False,
) -> dict[str, Any]:
    """Samples, and founds the gap. n: how many (0: as many as the profile or its beta asks for). progress(done, total, detail,
    seconds_left). left: why nobody waits for it any more, or empty; then it is interrupted. retry: repeat it once if its samples depend
    on each other. The answer: `exit_code` (0: complete), `text`, `n`, `rejected`, `log`, `gap`.

    Raises UsageError if `out` exists and there is nothing to go on with, ConfigError for what makes a start impossible.
    """
    script = _Script(n, permit_s, progress, left, RETRY if retry else "")
    daemon = Daemon(profile, profile_path=profile_path, state_dir=state_dir, log_file=out, seed=seed, on_tick=script)
    if out.exists() and not _unfinished(daemon.state_dir / "state.json"):
        raise UsageError(f"{out}: is there already, and there is no unfinished campaign to go on with; name another file")
    code = daemon.run()
    log, sampler = daemon.logbook.paths[-1], daemon.sampler
    if code == 0 and not script.text:
        script.exit_code, script.text = (
            1,
            f"interrupted after {len(sampler.samples)} of {sampler.n} samples; the same command goes on with it",
        )
    return {
        "exit_code": code or script.exit_code,
        "text": f"{script.text}\n{log}" if script.text else f"internal error; what was recorded is in {log}",
        "log": str(log),
        "n": len(sampler.samples),
        "rejected": sampler.rejected,
        "gap": msgspec.to_builtins(daemon.actions.results.get("gap")),
    }


def _unfinished(file: Path) -> bool:
    """Whether this state knows of a campaign to go on with. Raises ConfigError if it is damaged."""
    return file.exists() and unseal(read(file), "state", Memory, str(file)).campaign_epoch > 0
