"""What is known about the quadruped."""

from __future__ import annotations

from typing import NamedTuple


class QuadrupedSheet(NamedTuple):
    """Period of its link in s, limits of commands in m/s and rad/s, noise of the cameras in m and rad (standard deviations)."""

    dt: float = 0.1
    v_max: float = 0.15
    w_max: float = 0.3
    sigma_position: float = 0.0005
    sigma_heading: float = 0.002
