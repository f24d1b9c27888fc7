"""Observations and commands while a controller drives -> discrepancies, and what the watch's tests make of them (guarantee G5)."""

from __future__ import annotations

import math
import sys
from collections import deque
from collections.abc import Sequence
from typing import TYPE_CHECKING

from s2r_runtime.core.ledger import seed
from s2r_runtime.core.stream import bin_of
from s2r_runtime.evidence.comparison import EARLY, LATE
from s2r_runtime.evidence.watch.change import ChangeDetector
from s2r_runtime.evidence.watch.exceedance import EProcess
from s2r_runtime.evidence.watch.exchangeability import ConformalTest
from s2r_runtime.messages import GRID, IMPLAUSIBLE, RESTARTS, RULES, UNKNOWN_PAST, Gap, Measured, Observation, Send

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from s2r_runtime.models.composed import ComposedModel, Hidden

    Array = NDArray[np.float64]

EARLY_BEFORE = 0.2
"""Of dt: how far two observations might be from dt apart under rules before `GRID`. Since then a campaign's limits hold here, too."""

PAST_ROWS = 200
"""Commands that a transition of another length than a step is given as its past: some 20 s at 10 Hz. After that number no
command from before a restart counts, whatever an effect remembers.
"""

FORGOTTEN = 0.01
"""Largest share of the memory's difference from rest, at a restart, that no longer matters. A delay forgets all at once, a lag by a factor
of e per time constant.
"""

LONGEST_HOLD = 2000
"""Periods for which a held input is carried into an effect's memory; after more of them nothing changes any more."""


def measurement_fault(discrepancy: float, fault_jump: float) -> str:
    """Name of the rule that rejects this discrepancy as a fault of measurement, or empty.

    `jump`: no motion makes a discrepancy above `fault_jump` (the profile's, fixed beforehand; 0: there is no such rule).
    """
    return "jump" if 0.0 < fault_jump < discrepancy else ""


class Stream:
    """Observations and commands, in order -> one `Measured` for each transition that ended, for the audit to repeat.

    A transition is an observation, the one command that answered it, and the first observation that is one step later by the stamps, with a
    campaign's tolerance (`comparison`). It is compared with a step of its own length. Where an observation is lost, stands at another
    time, or another command was sent in between, there is none: `lost` counts those. The effects' memory goes on by the commands sent,
    whatever is observed; it begins at rest, and again when the robot restarted or its link was lost (`restarted`). Whether commands
    from before that act is unknown. So nothing is measured until the gate lets a controller command again, and until the memory is the
    same either way (`FORGOTTEN`). fault_jump: see `measurement_fault`. alpha, run_length: bars of the notices. rules: see `Settings`. The
    rest is where an earlier one stood: see the three tests.
    """

    def __init__(
        self,
        model: ComposedModel,
        gap: Gap,
        *,
        fault_jump: float = 0.0,
        n: int = 0,
        exceedances: int = 0,
        e_value: float | None = None,
        change: float = 0.0,
        exchange: float = 1.0,
        counts: Sequence[int] = (),
        alpha: float = 0.01,
        run_length: float = 1e5,
        rules: int = RULES,
    ) -> None:
        self._on_grid, self._notes_restarts, self._rules = rules >= GRID, rules >= RESTARTS, rules
        self._early, self._late = (EARLY, LATE if model.any_step else EARLY) if rules >= GRID else (EARLY_BEFORE, EARLY_BEFORE)
        self._model, self._radius, self._kind = model, gap.radius, gap.set
        self._weights, self._fault_jump = gap.weights, fault_jump
        self._dt_ns = model.dt * 1e9
        self.watch = EProcess(gap.epsilon, n=n, exceedances=exceedances, e_value=e_value)
        self.change = ChangeDetector(gap.epsilon, run_length, value=change)
        self.exchange = ConformalTest(seed("ties", gap.transitions_digest, gap.epoch), alpha, counts=counts, value=exchange)
        self.lost = 0
        self._before: Hidden | None = None
        self._begin()

    def restarted(self) -> None:
        """The robot started anew, or the link to it was lost or found: what it was commanded before says nothing about what acts."""
        if self._notes_restarts:
            self.lost += self._open is not None
            self._begin(self._before or self._hidden)  # lost, and found again: what was known before the first of them

    def _begin(self, before: Hidden | None = None) -> None:
        """At rest. before: the effects' memory, if the robot may still have it."""
        self._settled = not self._notes_restarts
        self._hidden = self._model.at_rest(1)
        self._before = before if self._rules >= UNKNOWN_PAST else None
        self._apart = self._differences()
        self._since = 0
        self._seen: Observation | None = None
        self._open: tuple[Observation, Send] | None = None
        self._last: Send | None = None
        self._clock_ns = 0.0  # on the robot's clock: up to where the memory has gone on
        self._commands: deque[tuple[float, tuple[float, ...]]] = deque(maxlen=PAST_ROWS)

    def sent(self, send: Send) -> None:
        """The robot was told this."""
        seen, last = self._seen, self._last
        self._settled = self._settled or send.source == "controller"
        fresh = seen is not None and send.obs_seq == seen.seq and (last is None or last.obs_seq != seen.seq)
        if self._open is not None:
            self.lost += 1
            self._open = None
        if last is not None:
            now = float(seen.stamp_ns) if fresh and seen is not None else self._clock_ns + max(0, send.t_ns - last.t_ns)
            periods = max(0, round((now - self._clock_ns) / self._dt_ns))
            self._hold(last.u, min(periods, LONGEST_HOLD))
            self._clock_ns += periods * self._dt_ns
        if fresh and seen is not None:
            self._clock_ns = float(seen.stamp_ns)
            self._open = (seen, send) if self._settled and self._is_known() else None
        self._last = send
        self._commands.append((self._clock_ns, send.u))

    def observed(self, observation: Observation) -> Measured | None:
        """The robot was seen there; what that says about the transition that ended with it (t_ns: 0), if one did."""
        seen = self._seen
        if observation.fault:
            return None
        if seen is not None and observation.stamp_ns < seen.stamp_ns:
            self._begin(self._before or self._hidden)  # the robot's clock restarted
        elif seen is not None and observation.seq < seen.seq and self._notes_restarts:
            self._begin(self._before or self._hidden)  # its numbers did
        elif seen is not None and observation.seq <= seen.seq:
            return None
        self._seen = observation
        if self._open is None:
            return None
        before, send = self._open
        periods = (observation.stamp_ns - before.stamp_ns) / self._dt_ns
        if periods < 1.0 - self._early:
            return None  # observations come faster than commands
        self._open = None
        if periods > 1.0 + self._late:
            self.lost += 1
            return None
        own = self._on_grid and self._model.any_step and abs(periods - 1.0) > EARLY
        return self._measured(observation, self._discrepancy(before, send, observation, periods * self._model.dt if own else None))

    def _discrepancy(self, before: Observation, send: Send, after: Observation, lasts: float | None) -> float:
        """lasts: s, where that is not one step."""
        import numpy as np

        from s2r_runtime.evidence.gap import discrepancy
        from s2r_runtime.evidence.prediction import acting

        model, u = self._model, np.array([send.u])
        if lasts is None:
            predicted, _ = model.step(np.array([before.x]), u, self._hidden)
        else:
            mean, end = acting(model, [self._past(before.stamp_ns)], u, np.array([[lasts]]))
            predicted = model.advance(np.array([before.x]), mean[:, 0], end[:, 0], np.array([lasts]))
        e = model.difference(np.array([after.x]), predicted)
        d = float(discrepancy(e, np.array(self._weights), self._kind)[0])
        return d if math.isfinite(d) else sys.float_info.max  # a model that breaks down is no reason to look away

    def _past(self, until_ns: float) -> tuple[Array, Array]:
        """The commands before that stamp: how long each lasted (k,) s, and which (k, nu)."""
        import numpy as np

        rows = [(begin, u) for begin, u in self._commands if begin < until_ns]
        ends = [*(begin for begin, _ in rows[1:]), until_ns][: len(rows)]
        lasts = np.array([max(0.0, end - begin) for (begin, _), end in zip(rows, ends, strict=True)]) * 1e-9
        return lasts, np.array([u for _, u in rows]).reshape(len(rows), len(self._model.inputs))

    def _measured(self, observation: Observation, d: float) -> Measured:
        broke_down = self._rules >= IMPLAUSIBLE and d == sys.float_info.max  # the model: that is no fault of measurement
        fault = "" if broke_down else measurement_fault(d, self._fault_jump)
        if not fault:
            exceeds = d > self._radius
            self.watch.update(exceeds)
            self.change.update(exceeds)
            self.exchange.update(bin_of(d, self._radius))
        watch = self.watch
        return Measured(
            0,
            observation.seq,
            d,
            fault,
            watch.e_value,
            watch.n,
            watch.exceedances,
            change=self.change.value,
            exchange=self.exchange.value,
        )

    def _hold(self, u: tuple[float, ...], periods: int) -> None:
        import numpy as np

        command = np.array([u])
        for _ in range(periods):
            _, _, self._hidden = self._model.act(command, self._hidden)
            if self._before:
                _, _, self._before = self._model.act(command, self._before)

    def _is_known(self) -> bool:
        """Whether what acts is the same, whether the robot began at rest or still had the commands from before its restart."""
        if self._before:
            self._since += 1
            if self._since >= PAST_ROWS or all(
                now <= FORGOTTEN * first for now, first in zip(self._differences(), self._apart, strict=True)
            ):
                self._before = None
        return not self._before

    def _differences(self) -> list[float]:
        """The largest one in each effect's memory; clocks aside."""
        pairs = zip(self._model.effects, self._before, self._hidden, strict=True) if self._before else ()
        return [float(abs(a - b).max(initial=0.0)) for one, a, b in pairs if not getattr(one.effect, "timed", False)]
