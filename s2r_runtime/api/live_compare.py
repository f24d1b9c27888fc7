"""`s2r compare --live`: two certified controllers drive common scenarios in turns, through the running daemon (guarantee G14).

    pair i    scenario i of the comparison's seed; A drives it first where i is even, else B
    a run     the daemon's own `deploy`, of that one scenario; it begins with the gate open and ends by itself
    a look    after every run, at the daemon's log: the same functions judge it as `s2r compare A B LOG` does

Nothing here is on the command path. If this program ends, a run in progress ends with its scenario, and nothing drives after it.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from s2r_runtime.api import live
from s2r_runtime.api.models import controller_at, load_checked
from s2r_runtime.api.progress import Watcher
from s2r_runtime.api.trials import check_logs, task_of
from s2r_runtime.errors import NotEnoughEvidence, S2RError, UsageError
from s2r_runtime.evidence import seeds
from s2r_runtime.evidence.compared_runs import Compared, judge_compared
from s2r_runtime.evidence.logged_deployments import CHANNELS, Replay, read_deployments
from s2r_runtime.evidence.run_pairs import Pairs, from_logs
from s2r_runtime.evidence.scores import Score
from s2r_runtime.models.composed import compose
from s2r_runtime.recording.followed import FollowedLog

LOOK_S = 0.1
"""Between two looks at the log: its chunks reach the file every 50 ms."""
CLOSED_S = 40.0
"""So long the gate may be closed while a run waits for it: more than a controller may take to start (`hosted.START_TIMEOUT_S`). Then the
run is ended: a latched gate opens for no comparison.
"""
RECORDED_WITHIN_S = 5.0
"""After a run: for what it counts as to be in the log."""
LEFT = "this program was interrupted"


class Side(NamedTuple):
    """A controller: its file, its parameters, and its digest."""

    path: Path
    param: Mapping[str, float]
    digest: str


class Ended(NamedTuple):
    """What a live comparison came to. pairs: None without a pair. logs: of this daemon. stopped: why it ended before it was over, or
    empty.
    """

    pairs: Pairs | None
    left_out: dict[str, int]
    logs: list[Path]
    seed: int
    stopped: str


class LiveComparison:
    """One comparison on one daemon."""

    def __init__(
        self,
        controllers: tuple[Path, Path],
        params: tuple[Mapping[str, float], Mapping[str, float]],
        profile_path: Path,
        logs: Sequence[Path],
        score: Score,
        seed: int,
        watcher: Watcher,
    ) -> None:
        """logs: of earlier daemons, whose pairs of this seed count too. seed: 0 begins a comparison of its own.

        Raises UsageError if no daemon of the profile's robot answers, or for one controller twice; ConfigError for the daemon of another
        profile, and for logs that do not hold.
        """
        self._profile = load_checked(profile_path)
        self._task = task_of(self._profile, compose(self._profile.model, f"{profile_path}: model"))
        files = [controller_at(path, param) for path, param in zip(controllers, params, strict=True)]
        if files[0].digest == files[1].digest:
            raise UsageError(f"{controllers[0]} and {controllers[1]} are one controller; a live comparison needs two")
        self._sides = tuple(Side(*one) for one in zip(controllers, params, (file.digest for file in files), strict=True))
        self._socket = live.connect(self._profile.robot.name).socket
        self._score, self._watcher, self.seed = score, watcher, seed or seeds.drawn()
        status = self._status()
        self._earlier: list[Any] = []
        if logs:
            check_logs(logs, watcher)
            self._earlier = list(read_deployments(logs, self._profile, self._task))
        self._log = FollowedLog(Path(status["log"]), CHANNELS)
        self._replay = Replay(self._profile, self._task)
        self._read()

    def run(self, most: int, look: Callable[[str, Pairs | None], bool]) -> Ended:
        """Drives up to `most` pairs. look: called after every run with a line about it and all pairs so far; True: decided, stop."""
        stopped = ""
        try:
            for index in range(most):
                order = self._sides if index % 2 == 0 else self._sides[::-1]
                for side in order:
                    if self._driven(side, index):
                        continue
                    stopped = self._drive(side, index)
                    if look(self._line(side, index), self.found()[0]) or stopped:
                        return self._ended(stopped)
        except KeyboardInterrupt:
            self._undeploy()
            time.sleep(5 * LOOK_S)  # until a deployment that had just begun is in the log
            self._read()
            if self._replay.deployments:
                self._wait(len(self._replay.deployments) - 1)
            stopped = LEFT
        return self._ended(stopped)

    def found(self) -> tuple[Pairs | None, dict[str, int]]:
        """All pairs of this comparison so far, and which runs were left out, by reason."""
        judged = [self._judged(side) for side in self._sides]
        left_out = {f"{name}: {why}": n for name, one in zip("AB", judged, strict=True) for why, n in one.left_out.items()}
        try:
            return from_logs(judged[0], judged[1], self._score, "scenario"), left_out
        except NotEnoughEvidence:
            return None, left_out

    def _ended(self, stopped: str) -> Ended:
        return Ended(*self.found(), self._log.paths, self.seed, stopped)

    def _judged(self, side: Side) -> Compared:
        deployments = [*self._earlier, *self._replay.deployments]
        return judge_compared(deployments, side.digest, self._profile.verification.threshold, self.seed)

    def _driven(self, side: Side, index: int) -> bool:
        """Whether it met this scenario, in whatever way that ended: a second time is no run of its own."""
        deployments = (*self._earlier, *self._replay.deployments)
        mine = [one.scenarios for one in deployments if one.digest == side.digest and one.seed == self.seed]
        return any(of is not None and of.first <= index < of.first + of.count for of in mine)

    def _line(self, side: Side, index: int) -> str:
        name = "AB"[self._sides.index(side)]
        outcome = next((outcome for run, outcome in self._judged(side).runs if run.index == index), "left out")
        return f"pair {index + 1}, {name}: {outcome}"

    # ------------------------------------------------------------------ the robot

    def _drive(self, side: Side, index: int) -> str:
        """One run. Returns why the comparison cannot go on, or empty."""
        number = len(self._replay.deployments)
        try:
            request = {**live.deploy_request(side.path, side.param, None), "seed": self.seed, "first": index, "count": 1}
            answer = live.talk(self._socket, request, self._watcher)
        except S2RError as error:
            self._read()
            return f"the daemon does not answer: {error}"
        if answer["exit_code"]:
            return f"{side.path}: {answer['text']}"
        return self._wait(number)

    def _wait(self, number: int) -> str:
        """Until that deployment is over and counted. Returns why the comparison cannot go on, or empty."""
        closed_since = looked = time.monotonic()
        stopped, ended_at = "", 0.0
        while True:
            self._read()
            now, one = time.monotonic(), self._replay.deployments[number] if number < len(self._replay.deployments) else None
            if one is not None and one.ended:
                ended_at = ended_at or now
                if all(run.outcome for run in one.runs) or now - ended_at > RECORDED_WITHIN_S:
                    return stopped
            if now - looked > 5 * LOOK_S:
                looked = now
                try:
                    status = self._status()
                except S2RError as error:
                    return f"the daemon does not answer: {error}"
                closed_since = now if status["gate"] == "open" else closed_since
                if now - closed_since > CLOSED_S and not ended_at:
                    stopped = f"the gate has been closed for {CLOSED_S:g} s ({status['reason']})"
                    self._undeploy()
                    closed_since = now
            time.sleep(LOOK_S)

    def _undeploy(self) -> None:
        """As `s2r undeploy`. Nothing to do where nothing is deployed."""
        try:
            live.talk(self._socket, {"verb": "undeploy"}, self._watcher)
        except S2RError:
            return

    def _status(self) -> dict[str, Any]:
        return dict(live.talk(self._socket, {"verb": "status"}, self._watcher)["data"])

    def _read(self) -> None:
        for part in self._log.parts():
            for _ in self._replay.read(part):
                pass
