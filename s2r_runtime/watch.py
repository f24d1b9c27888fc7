"""Sequential watch on the stream of discrepancies while a controller drives (guarantee G5). No independence is assumed.

X_i = 1 iff the i-th counted discrepancy exceeds the epoch's own r (never a grown one). Null hypothesis: P(X_i = 1 | past) <= eps.
For any p in (eps, 1) and any start k the product

    L_k(p) = prod_{i >= k} (p / eps)^X_i ((1-p) / (1-eps))^(1-X_i)

is a supermartingale under it: each factor's mean grows with P(X_i = 1 | past), and is 1 at eps. The e-value mixes such products, over a
grid of p and over the start k, so that a robot that changes after a long good time is caught about as soon as one bad at once:

    E_n = T(n) + sum_{k <= n} (T(k-1) - T(k)) mean_p L_k(p),      T(n) = 1 / (1 + ln(1 + n))

T(n) is the part not staked yet. E_0 = 1 and the mean of E_n is at most 1, so by Ville's inequality P(sup E_n >= 1/alpha) <= alpha: an
alarm at 1/alpha is false with probability at most alpha, over the whole epoch. A start after n good steps costs ln n + 2 ln ln n nats.
A discrepancy that a measurement-fault rule rejects is no X_i; a rule that rejects only exceedances keeps the null hypothesis true.

One number a p: memory and work an update are constant. Everything in logarithms: no overflow, no NaN.
"""

from __future__ import annotations

import math
import sys
from typing import TYPE_CHECKING

from s2r_runtime.messages import Gap, Measured, Observation, Send

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from s2r_runtime.models.composed import ComposedModel

    Array = NDArray[np.float64]

GRID = 8
"""Values of p, geometrically between eps and 1; the best of them loses a few per cent of the growth of the best p."""

LARGEST = 1e300
"""What an e-value above it is reported as."""

STAMP_TOLERANCE = 0.2
"""Of dt: how far two observations may be from dt apart to be the ends of one transition."""

LONGEST_HOLD = 2000
"""Periods for which a held input is carried into an effect's memory; after more of them nothing changes any more."""


class EProcess:
    """The e-value of the null hypothesis, exceedance by exceedance.

    n, exceedances, e_value: where an earlier one stood (a restart goes on there: what had been won is staked anew, evenly over the
    grid, which keeps every promise above; without the e_value it is given up). Raises ValueError if they can't be.
    """

    def __init__(self, epsilon: float, *, n: int = 0, exceedances: int = 0, e_value: float | None = None) -> None:
        if not 0.0 < epsilon < 1.0:
            raise ValueError(f"epsilon is {epsilon}, must be between 0 and 1")
        if not 0 <= exceedances <= n:
            raise ValueError(f"{exceedances} exceedances of {n}: must be between 0 and their number")
        p = [epsilon ** (1.0 - j / (GRID + 1)) for j in range(1, GRID + 1)]
        self._if_exceeds = [math.log(q / epsilon) for q in p]
        self._if_not = [math.log1p(-q) - math.log1p(-epsilon) for q in p]
        won = max(0.0, e_value - _unstaked(n)) if e_value is not None else 0.0
        self._log_won = [math.log(won / GRID) if won > 0.0 else -math.inf] * GRID
        self.n, self.exceedances = n, exceedances

    @property
    def e_value(self) -> float:
        """E_n, at most LARGEST."""
        most = max(self._log_won)
        if most > math.log(LARGEST / GRID):
            return LARGEST
        return _unstaked(self.n) + sum(math.exp(log_won) for log_won in self._log_won)

    def update(self, exceeds: bool) -> float:
        """One more counted discrepancy; gives the e-value after it."""
        self.n += 1
        self.exceedances += exceeds
        n = self.n
        stake = math.log(math.log1p(1.0 / n) / ((1.0 + math.log(n)) * (1.0 + math.log1p(n))) / GRID)
        growth = self._if_exceeds if exceeds else self._if_not
        self._log_won = [_log_add(won, stake) + g for won, g in zip(self._log_won, growth, strict=True)]
        return self.e_value


def measurement_fault(discrepancy: float, fault_jump: float) -> str:
    """Name of the rule that rejects this discrepancy as a fault of measurement, or empty.

    `jump`: no motion makes a discrepancy above `fault_jump` (the profile's, fixed beforehand; 0: there is no such rule).
    """
    return "jump" if 0.0 < fault_jump < discrepancy else ""


class Stream:
    """Observations and commands, in order -> one `Measured` for each transition that ended, for the audit to repeat.

    A transition is an observation, the one command that answered it, and the next observation about dt later. Where an observation
    is lost, stands at another time, or another command was sent in between, there is none: `lost` counts those. The effects' memory
    goes on by the commands sent, whatever is observed; it begins at rest. fault_jump: see `measurement_fault`. The rest: `EProcess`.
    """

    def __init__(
        self, model: ComposedModel, gap: Gap, *, fault_jump: float = 0.0, n: int = 0, exceedances: int = 0, e_value: float | None = None
    ) -> None:
        self._model, self._radius, self._kind = model, gap.radius, gap.set
        self._weights, self._fault_jump = gap.weights, fault_jump
        self._dt_ns = model.dt * 1e9
        self.watch = EProcess(gap.epsilon, n=n, exceedances=exceedances, e_value=e_value)
        self.lost = 0
        self._begin()

    def _begin(self) -> None:
        self._hidden = self._model.at_rest(1)
        self._seen: Observation | None = None
        self._open: tuple[Observation, Send] | None = None
        self._last: Send | None = None
        self._clock_ns = 0.0  # on the robot's clock: up to where the memory has gone on

    def sent(self, send: Send) -> None:
        """The robot was told this."""
        seen, last = self._seen, self._last
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
            self._open = (seen, send)
        self._last = send

    def observed(self, observation: Observation) -> Measured | None:
        """The robot was seen there; what that says about the transition that ended with it (t_ns: 0), if one did."""
        seen = self._seen
        if observation.fault:
            return None
        if seen is not None and observation.stamp_ns < seen.stamp_ns:
            self._begin()  # the robot's clock began anew
        elif seen is not None and observation.seq <= seen.seq:
            return None
        self._seen = observation
        if self._open is None:
            return None
        before, send = self._open
        periods = (observation.stamp_ns - before.stamp_ns) / self._dt_ns
        if periods < 1.0 - STAMP_TOLERANCE:
            return None  # observations come faster than commands
        self._open = None
        if periods > 1.0 + STAMP_TOLERANCE:
            self.lost += 1
            return None
        return self._measured(observation, self._discrepancy(before, send, observation))

    def _discrepancy(self, before: Observation, send: Send, after: Observation) -> float:
        import numpy as np

        from s2r_runtime.gap import discrepancy

        model = self._model
        predicted, _ = model.step(np.array([before.x]), np.array([send.u]), self._hidden)
        e = model.difference(np.array([after.x]), predicted)
        d = float(discrepancy(e, np.array(self._weights), self._kind)[0])
        return d if math.isfinite(d) else sys.float_info.max  # a model that breaks down is no reason to look away

    def _measured(self, observation: Observation, d: float) -> Measured:
        fault = measurement_fault(d, self._fault_jump)
        if not fault:
            self.watch.update(d > self._radius)
        watch = self.watch
        return Measured(0, observation.seq, d, fault, watch.e_value, watch.n, watch.exceedances)

    def _hold(self, u: tuple[float, ...], periods: int) -> None:
        import numpy as np

        command = np.array([u])
        for _ in range(periods):
            _, _, self._hidden = self._model.act(command, self._hidden)


def _unstaked(n: int) -> float:
    """T(n)."""
    return 1.0 / (1.0 + math.log1p(n))


def _log_add(a: float, b: float) -> float:
    """log(exp(a) + exp(b)); b is finite."""
    high, low = max(a, b), min(a, b)
    return high + math.log1p(math.exp(low - high))
