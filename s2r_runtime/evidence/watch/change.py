"""Has the robot changed? An e-detector of the Shiryaev-Roberts kind, with a stated average run length (guarantee G5).

X_i, eps and the grid of p as in `exceedance`. Under P(X_i = 1 | past) <= eps every likelihood ratio that begins at step k is a
supermartingale of mean at most 1, so the sum over all starts grows by no more than 1 a step on average:

    R_n = mean_p sum_{k <= n} L_k(p) = mean_p R_n(p),      R_n(p) = (1 + R_{n-1}(p)) (p/eps)^X_n ((1-p)/(1-eps))^(1-X_n)

R_n - n is a supermartingale, so the first time at which R_n >= A comes after at least A steps on average: the mean number of discrepancies
between two false notices is at least A, whatever the dependence (Shiryaev 1963; Roberts 1966; Shin, Ramdas & Rinaldo 2023). After a notice
it begins anew. It is quicker than the e-process, and pays for that: over a long life it gives false notices, at the rate 1/A, where the
e-process gives one at all with probability alpha. So its notice revokes nothing.

One number a p. It never overflows, because it begins anew at A.
"""

from __future__ import annotations

from s2r_runtime.evidence.watch.exceedance import GRID, grid


class ChangeDetector:
    """run_length: A. value: where an earlier one stood (a restart goes on there, spread evenly over the grid: R_n - n stays what it is)."""

    def __init__(self, epsilon: float, run_length: float, *, value: float = 0.0) -> None:
        if not 1.0 <= run_length < 1e300:
            raise ValueError(f"run_length is {run_length}, must be at least 1")
        p = grid(epsilon)
        self._if_exceeds = [q / epsilon for q in p]
        self._if_not = [(1.0 - q) / (1.0 - epsilon) for q in p]
        self._run_length = run_length
        self._sums = [0.0 if value >= run_length else max(0.0, value) / GRID] * GRID
        self.value = sum(self._sums)

    def update(self, exceeds: bool) -> float:
        """One more counted discrepancy; gives R_n. At run_length or more that is a notice, and the next begins from 0."""
        if self.value >= self._run_length:
            self._sums = [0.0] * GRID
        factors = self._if_exceeds if exceeds else self._if_not
        self._sums = [(1.0 / GRID + r) * factor for r, factor in zip(self._sums, factors, strict=True)]
        self.value = sum(self._sums)
        return self.value
