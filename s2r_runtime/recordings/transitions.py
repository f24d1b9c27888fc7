"""Transitions of a robot: a state, an input, and the state one step later. What `loading` reads, and gap and tracer use."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from s2r_runtime.recordings.table_rows import Subset

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Holds:
    """The held inputs that n samples were taken from.

    lasts: (n,) s, from x0 to x1. start: (n, nx), state at the hold's beginning; elapsed: (n,) s, from there to x0; ends: (n,) s, from there
    to the hold's end, 0 where that was not recorded. past: of each, the commands before the hold, oldest first: how long each lasted
    (m,) s, and which it was (m, nu). law: which period of a hold gives the sample, `random` or `first`.
    """

    lasts: Array
    elapsed: Array
    start: Array
    ends: Array
    past: tuple[tuple[Array, Array], ...]
    law: str

    def chosen(self, index: NDArray[np.int64]) -> Holds:
        """Those of these numbers (m,)."""
        past = tuple(self.past[i] for i in index)
        return Holds(self.lasts[index], self.elapsed[index], self.start[index], self.ends[index], past, self.law)


@dataclass(frozen=True)
class Drive:
    """All steps of a run, so that an effect with memory can be carried along: inputs, one (m, nu) a stretch that begins at
    rest; step: (n,) where each transition is in them, laid end to end.
    """

    inputs: tuple[Array, ...]
    step: NDArray[np.int64]


@dataclass(frozen=True)
class Transitions:
    """n transitions. x0, x1: (n, nx); u: (n, nu); t0_s: (n,). held: (n, nx), the state after `hold_periods` held periods, or None.

    `independent`: drawn independently from one distribution; if not, `doubt` says why, and there is no statement. `assumption`: what
    the user vouched for instead. `digest`: of the recording's bytes; `samples_digest`: of a campaign's samples, alike in every log that
    holds them; `content_digest`: of a table's numbers, however they are written; for driving in a daemon's log, of which run it is.
    `noise`: (nx,) standard deviation of the measurements, None if the recording doesn't show it. `subset`: which rows of a long recording
    are used (None: all). `holds`: of a campaign's samples, how long each lasted and what was commanded before; None: one step, from rest.
    """

    x0: Array
    u: Array
    x1: Array
    held: Array | None
    hold_periods: int
    independent: bool
    rejected: dict[str, int]
    digest: str
    t0_s: Array
    source: str
    doubt: str = ""
    assumption: str = ""
    samples_digest: str = ""
    content_digest: str = ""
    parts: tuple[str, ...] = ()
    """Digests of each recording, of its bytes and of its numbers, where there are several."""
    noise: Array | None = None
    drive: Drive | None = field(default=None, repr=False)
    holds: Holds | None = field(default=None, repr=False)
    measured: tuple[Array, ...] = field(default=(), repr=False)
    """States as measured, (m, nx) a run, NaN where one was not received, where the model was fitted; else x0 and x1 stand for them."""
    subset: Subset | None = None
    notes: tuple[str, ...] = ()
    """What a person should know of how the recording was read, one line each."""

    def chosen(self, index: NDArray[np.int64]) -> Transitions:
        """Those of these numbers (m,); all else is as it was."""
        return replace(
            self,
            x0=self.x0[index],
            u=self.u[index],
            x1=self.x1[index],
            t0_s=self.t0_s[index],
            held=None if self.held is None else self.held[index],
            drive=None if self.drive is None else replace(self.drive, step=self.drive.step[index]),
            holds=None if self.holds is None else self.holds.chosen(index),
        )
