"""The largest radius at which a controller still passes, within one attempt's beta (guarantee G2, G4, G5).

Fixed before anything is rolled out: K = STEPS radii from the least that will do, r (the gap as it has grown), to the most that is asked
for, H r,

    r_i = r H^(i / (K - 1)),   i = 0 .. K - 1,     each with  beta / K  of the attempt's share.

By the union bound all K statements hold at once with confidence 1 - beta, so whichever of the radii are looked at, in whatever order,
the statement at the one that is reported holds with it. They are looked at from the top, then by halving: a controller that passes at
H r costs one run, and none costs more than 1 + ceil(log2 K). Beta / K asks for ln(K) / eps more scenarios than beta. The hold gap goes
along in proportion.

That a controller which passes at a radius also passes at lesser ones is not assumed for the statement (it is about the radius
reported), only for finding it soon.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Protocol

STEPS = 8
"""Of 1.5 times r the steps are of 6 %, of 4 times r of 22 %; twice as many would cost one run more and 0.7 / eps scenarios."""


class Tried(Protocol):
    """A radius that was looked at: its index, and whether it passed."""

    @property
    def index(self) -> int:
        """i."""

    @property
    def passed(self) -> bool:
        """Whether every required law passed there."""


def grid(least: float, most: float) -> tuple[float, ...]:
    """The radii, ascending; only `most`, where there is nothing below it to be content with."""
    if not 0.0 < least < most:
        return (most,)
    inner = tuple(least * (most / least) ** (i / (STEPS - 1)) for i in range(1, STEPS - 1))
    return (least, *inner, most)


def search(count: int, passes: Callable[[int], bool]) -> int | None:
    """The largest index found at which it passes; None if not even at 0. passes(i) is asked of each i once at most."""
    failed, passed = count, -1
    at = count - 1
    while failed - passed > 1:
        if passes(at):
            passed = at
        else:
            failed = at
        at = (failed + passed) // 2
    return passed if passed >= 0 else None


def follows(tried: Sequence[Tried], count: int) -> bool:
    """Whether this is what `search` does when it is told these answers: nothing left out, nothing tried in passing."""
    answers = iter(tried)

    def passes(at: int) -> bool:
        one = next(answers, None)
        if one is None or one.index != at:
            raise LookupError
        return one.passed

    try:
        search(count, passes)
    except LookupError:
        return False
    return next(answers, None) is None
