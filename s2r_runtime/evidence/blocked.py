"""A gap from ordinary driving, under a mixing assumption that the profile states (guarantee G1, G4, G7). Without one it founds nothing.

One transition is taken from each block of `block` s, no two nearer than that (up to a step of the model). The first M blocks count, which
hold N different transitions; N is fixed by the share of beta alone. If the driving is stationary and its beta-mixing coefficient at the
distance of a block is at most m, these M are independent draws of its distribution but with probability (M-1) m (Berbee 1979; Yu 1994):

    P[V(r) > eps] <= P(Bin(N, eps) <= k) + (M-1) m,        each half of the epoch's share at most

Copies say nothing new (`repeats`). Where they are equal draws, the (k+1)-th largest of M is at least that of the first N, whenever one
stops. Where they are copies of one draw, the N different ones are the draws, and copies only enlarge the (k+1)-th largest.

The law is that of the driving, not of a campaign: the controller that drove, where it drove.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from s2r_runtime.errors import NotEnoughEvidence
from s2r_runtime.evidence.bounds import sample_size, split
from s2r_runtime.evidence.gap import blocked
from s2r_runtime.evidence.repeats import distinct
from s2r_runtime.evidence.statements import assumption
from s2r_runtime.profile import Driving
from s2r_runtime.recordings.transitions import Transitions

STEP = 50
"""Blocks are added by a fiftieth at least, so that a robot that stood still for long is read in a few passes."""


def founding(
    tr: Transitions,
    driving: Driving,
    dt: float,
    *,
    epsilon: float,
    share: float,
    discard: int,
    angles: Sequence[int] = (),
) -> Transitions:
    """The M transitions of a recording that the profile vouches for. share: of beta, the epoch's. dt: model's step, s. angles: of a state.

    Raises NotEnoughEvidence: the drive is too short (with how many blocks more would do), or the mixing too weak for the share.
    """
    for_bound, for_mixing = split(share, (1, 1))
    n = sample_size(epsilon, for_bound, discard)
    blocks = blocked(tr, driving.block, dt)
    have = len(blocks.x0)
    take = _holding(blocks, n, angles)
    if (take - 1) * driving.mixing > for_mixing:
        raise NotEnoughEvidence(
            f"driving.mixing is {driving.mixing:g}: over {take} blocks that is {(take - 1) * driving.mixing:.2g}, more than half of the "
            f"epoch's share of beta, {for_mixing:.2g}; take longer blocks, whose mixing coefficient is smaller"
        )
    if take > have:
        copies = take - n  # have less what differs
        there = f"{have} blocks of {driving.block:g} s" + (f", {copies} of them copies of others" if copies else "")
        raise NotEnoughEvidence(f"{tr.source}: {there}; {n} different ones are needed: {take - have} more", take - have)
    first = blocks.chosen(np.arange(take))
    left_out = {"later_blocks": have - take} if have > take else {}
    return replace(first, assumption=assumption(driving), rejected={**blocks.rejected, **left_out})


def _holding(blocks: Transitions, n: int, angles: Sequence[int]) -> int:
    """How many blocks, from the first, hold n different transitions; if all do not, their number and as many as are missing."""
    have, take = len(blocks.x0), n
    while True:
        some = blocks.chosen(np.arange(min(take, have)))
        missing = n - distinct(some.x0, some.u, some.x1, angles)
        if missing <= 0:
            return take
        if take >= have:
            return have + missing
        take = min(have, take + max(missing, take // STEP))
