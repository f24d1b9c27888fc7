"""Actuators that no effect of the library names (the tracer knows them as unnamed nonlinearities): kinds that change what acts."""

from __future__ import annotations

import math

from trace_sets.outside_shapes import Acting, Drawn, Rng, an_input, another, either, memory_of, product
from trace_sets.plants import Numbers
from trace_sets.scale import Scale, log_uniform
from trace_sets.world import Moment


def resonance(rng: Rng, s: Scale, size: float) -> Drawn:
    """A second-order actuator that rings."""
    c = an_input(rng, s)
    rate = min(math.tau * log_uniform(rng, 0.6, 5.0), 0.5 / s.dt)
    damping = float(rng.uniform(0.08, 0.35))

    def f(m: Moment, a: Numbers, z: Numbers) -> None:
        before = z[0]
        z[1] += m.h * (rate * rate * (a[c.j] - z[0]) - 2.0 * damping * rate * z[1])
        z[0] += m.h * z[1]
        a[c.j] = 0.5 * (before + z[0])

    return Acting(f, 2), memory_of(s.plant, c.name), {"rate": rate, "damping": damping, "channel": c.name}


def lazy_when_fast(rng: Rng, s: Scale, size: float) -> Drawn:
    """Dead time that grows with what is asked."""
    c = an_input(rng, s)
    usual = min(0.15 * s.pace * size, s.duration / 20.0)

    def f(m: Moment, a: Numbers, z: Numbers) -> None:
        a[c.j] = m.command(c.j, (0.2 + 1.8 * abs(a[c.j]) / c.most) * usual / m.world.h)

    return Acting(f), memory_of(s.plant, c.name), {"delay": usual, "channel": c.name}


def uneven_lag(rng: Rng, s: Scale, size: float) -> Drawn:
    """Follows faster away from zero than back to it."""
    c = an_input(rng, s)
    up = min(0.15 * s.pace * size, s.duration / 20.0)
    down = up * log_uniform(rng, 3.0, 8.0)

    def f(m: Moment, a: Numbers, z: Numbers) -> None:
        before = z[0]
        z[0] = a[c.j] + (before - a[c.j]) * math.exp(-m.h / (up if abs(a[c.j]) > abs(before) else down))
        a[c.j] = 0.5 * (before + z[0])

    return Acting(f, 1), memory_of(s.plant, c.name), {"up": up, "down": down, "channel": c.name}


def bouc_wen(rng: Rng, s: Scale, size: float) -> Drawn:
    """A smooth hysteresis loop around the command."""
    c = an_input(rng, s)
    width, share = 0.4 * c.most, min(0.35 * size, 0.8)

    def f(m: Moment, a: Numbers, z: Numbers) -> None:
        du = (a[c.j] - z[1]) / width
        z[1] = a[c.j]
        z[0] += du - abs(du) * z[0] if abs(du) < 0.5 else 0.0
        if abs(du) >= 0.5:  # a jump: in small parts
            for _ in range(20):
                z[0] += (du - abs(du) * z[0]) / 20.0
        a[c.j] -= share * c.most * z[0]

    return Acting(f, 2), memory_of(s.plant, c.name) | {c.name}, {"width": width, "share": share, "channel": c.name}


def sticky(rng: Rng, s: Scale, size: float) -> Drawn:
    """Stick-slip: it stays until the command is far enough away, and then jumps to it."""
    c = an_input(rng, s)
    reach = min(0.5 * size, 0.9) * c.most

    def f(m: Moment, a: Numbers, z: Numbers) -> None:
        if abs(a[c.j] - z[0]) > reach:
            z[0] = a[c.j]
        a[c.j] = z[0]

    return Acting(f, 1), memory_of(s.plant, c.name) | {c.name}, {"reach": reach, "channel": c.name}


def exhausted(rng: Rng, s: Scale, size: float) -> Drawn:
    """A battery: the gain falls with all that was ever asked, and settles."""
    c = an_input(rng, s)
    spent, loss = 0.25 * s.duration * c.most, min(0.4 * size, 0.85)

    def f(m: Moment, a: Numbers, z: Numbers) -> None:
        z[0] += m.h * abs(a[c.j])
        a[c.j] *= 1.0 - loss * math.tanh(z[0] / spent)

    tokens = {f"memory({c.name})", f"time*{c.name}", "time", c.name}
    return Acting(f, 1), tokens, {"loss": loss, "channel": c.name}


def fade(rng: Rng, s: Scale, size: float) -> Drawn:
    """A motor that warms up with what it is asked, fades, and recovers."""
    c = an_input(rng, s)
    time_constant = s.pace * log_uniform(rng, 1.0, 4.0)
    loss = min(0.9 * size, 3.0)

    def f(m: Moment, a: Numbers, z: Numbers) -> None:
        z[0] += m.h / time_constant * ((a[c.j] / c.most) ** 2 - z[0])
        a[c.j] /= 1.0 + loss * z[0]

    tokens = {f"memory({c.name})", f"time*{c.name}", c.name}
    return Acting(f, 1), tokens, {"time_constant": time_constant, "loss": loss, "channel": c.name}


def cross_square(rng: Rng, s: Scale, size: float) -> Drawn:
    """The gain of one input falls with the square of the other. (A car's steering that does so understeers: that has a name.)"""
    c = an_input(rng, s)
    c, other = (another(s, c), c) if c.name == "steer_cmd" else (c, another(s, c))
    loss = min(0.6 * size, 0.95)

    def f(m: Moment, a: Numbers, z: Numbers) -> None:
        a[c.j] *= 1.0 - loss * (a[other.j] / other.most) ** 2

    return Acting(f), product(c.name, other.name), {"coefficient": loss, "channel": c.name}


def cubic(rng: Rng, s: Scale, size: float) -> Drawn:
    """Hammerstein: a cubic before the robot."""
    c = an_input(rng, s)
    share = either(rng) * min(0.5 * size, 0.9)

    def f(m: Moment, a: Numbers, z: Numbers) -> None:
        a[c.j] += share * a[c.j] * ((a[c.j] / c.most) ** 2 - 0.6)

    return Acting(f), {c.name}, {"coefficient": share, "channel": c.name}


def coarse(rng: Rng, s: Scale, size: float) -> Drawn:
    """The driver knows a few levels only."""
    c = an_input(rng, s)
    step = min(0.5 * size, 0.9) * c.most

    def f(m: Moment, a: Numbers, z: Numbers) -> None:
        a[c.j] = step * round(a[c.j] / step)

    return Acting(f), {c.name}, {"step": step, "channel": c.name}


def ripple(rng: Rng, s: Scale, size: float) -> Drawn:
    """The supply's voltage swings, and the gain with it."""
    c = an_input(rng, s)
    frequency, share = log_uniform(rng, 3.0, 15.0) / s.duration, min(0.4 * size, 0.9)

    def f(m: Moment, a: Numbers, z: Numbers) -> None:
        a[c.j] *= 1.0 + share * math.sin(math.tau * frequency * m.t)

    return Acting(f), {f"time*{c.name}", "time"}, {"frequency": frequency, "share": share, "channel": c.name}


def lost_commands(rng: Rng, s: Scale, size: float) -> Drawn:
    """Now and then nothing arrives for a while, and the drive stops."""
    c = an_input(rng, s)
    count = int(rng.integers(5, 12))
    begins = sorted((s.duration * rng.uniform(0.02, 0.95, count)).tolist())
    length = max(min(0.5 * s.pace * size, 0.03 * s.duration), 3.0 * s.dt)

    def f(m: Moment, a: Numbers, z: Numbers) -> None:
        if any(b <= m.t < b + length for b in begins):
            a[c.j] = 0.0

    return Acting(f), {f"time*{c.name}", "time", "noise", c.name}, {"length": length, "begins": begins, "channel": c.name}


def jerk_coupling(rng: Rng, s: Scale, size: float) -> Drawn:
    """One input answers to changes of the other (a nose that dips when braking)."""
    c = an_input(rng, s)
    other = another(s, c)
    time_constant, share = max(0.2 * s.pace, 2.0 * s.dt), either(rng) * 0.4 * size * c.most / other.most

    def f(m: Moment, a: Numbers, z: Numbers) -> None:
        z[0] += (a[other.j] - z[0]) * (1.0 - math.exp(-m.h / time_constant))
        a[c.j] += share * (a[other.j] - z[0])

    return Acting(f, 1), memory_of(s.plant, other.name), {"share": share, "time_constant": time_constant, "channel": c.name}


def overshoot(rng: Rng, s: Scale, size: float) -> Drawn:
    """A driver that boosts what changes (lead), more than it should."""
    c = an_input(rng, s)
    time_constant, share = max(0.3 * s.pace, 3.0 * s.dt), 0.5 * size

    def f(m: Moment, a: Numbers, z: Numbers) -> None:
        z[0] += (a[c.j] - z[0]) * (1.0 - math.exp(-m.h / time_constant))
        a[c.j] += share * (a[c.j] - z[0])

    return Acting(f, 1), memory_of(s.plant, c.name), {"share": share, "time_constant": time_constant, "channel": c.name}
