"""A gap from ordinary driving, under a mixing assumption that the profile states (guarantee G1, G4, G7). Without one it founds nothing.

One transition is taken from each block of `block` s, no two nearer than that (up to a step of the model); the first N blocks count, N fixed
by the share of beta alone, so that nobody stops a drive when r looks good. If the driving is stationary and its beta-mixing coefficient at
the distance of a block is at most m, these N are independent draws of its law but with probability (N-1) m (Berbee 1979; Yu 1994):

    P[V(r) > eps] <= P(Bin(N, eps) <= k) + (N-1) m,        each half of the epoch's share at most

The law is that of the driving, not of a campaign: the controller that drove, where it drove.
"""

from __future__ import annotations

from dataclasses import replace

from s2r_runtime.bounds import sample_size, split
from s2r_runtime.errors import NotEnoughEvidence
from s2r_runtime.gap import Transitions, blocked
from s2r_runtime.profile import Driving
from s2r_runtime.statements import assumption


def founding(tr: Transitions, driving: Driving, dt: float, *, epsilon: float, share: float, discard: int) -> Transitions:
    """The N transitions of a drive that the profile vouches for. share: of beta, the epoch's. dt: the model's step, s.

    Raises NotEnoughEvidence: the drive is too short (with how many blocks more would do), or the mixing too weak for the share.
    """
    for_bound, for_mixing = split(share, (1, 1))
    n = sample_size(epsilon, for_bound, discard)
    if (n - 1) * driving.mixing > for_mixing:
        raise NotEnoughEvidence(
            f"driving.mixing is {driving.mixing:g}: over {n} blocks that is {(n - 1) * driving.mixing:.2g}, more than half of the epoch's "
            f"share of beta, {for_mixing:.2g}; take longer blocks, whose mixing coefficient is smaller"
        )
    blocks = blocked(tr, driving.block, dt)
    have = len(blocks.x0)
    if have < n:
        raise NotEnoughEvidence(f"{tr.source}: {have} blocks of {driving.block:g} s, {n} are needed: {n - have} more", n - have)
    first = slice(0, n)
    drive = blocks.drive
    return replace(
        blocks,
        x0=blocks.x0[first],
        u=blocks.u[first],
        x1=blocks.x1[first],
        t0_s=blocks.t0_s[first],
        assumption=assumption(driving),
        rejected={**blocks.rejected, "later_blocks": have - n} if have > n else blocks.rejected,
        drive=None if drive is None else replace(drive, step=drive.step[first]),
    )
