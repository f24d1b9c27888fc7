"""The quadruped stand-in: does it fall, does it go where it is told to, and how fast is its simulation?

    python tools/bench_quadruped.py [--minutes 30] [--seeds 5] [--holds 60] [--effect EFFECT ...] [--json] [--video FILE | --frames FOLDER]

falls      so many simulated minutes for each seed, on floors of friction 0.4 to 0.8 (one a seed), under commands drawn uniformly from
           v in [-0.15, 0.15] m/s, w in [-0.3, 0.3] rad/s and held for 0.9 to 1.1 s
tracking   commands drawn alike, held for 6 s: the mean forward speed and yaw rate of the last 5 s against the command, by least squares:
           gain and bias of each; and the largest deviation of one hold from its command
factor     simulated time over time of the processor in the falls part, rendering off
--video    a walk as a film (.gif, or whatever ffmpeg makes of its name if it is installed), --frames as numbered pictures

Exit 1 if a figure misses its target: no fall, gains 0.9 to 1.05, biases at most 0.01, factor at least 10. With --effect it shows what
comes of what is wrong with the robot, and judges nothing.
"""

from __future__ import annotations

import argparse
import json
import math
import random
import sys
import time
from pathlib import Path

import numpy as np
from quadruped_film import film
from s2r_standins.quadruped_body import Quadruped

V_MAX, W_MAX = 0.15, 0.3
FRICTIONS = (0.4, 0.8)
GAIN, BIAS, FACTOR = (0.9, 1.05), 0.01, 10.0
HOLD_S, JUDGED_S = 6.0, 5.0


def falls(minutes: float, seeds: int, effects: list[str]) -> dict[str, object]:
    """Walks under random commands. `fell`: what befell whom; `lean_deg`: the largest lean at the end of a command."""
    fell, lean, walked = [], 0.0, 0.0
    begin = time.process_time()
    robot = Quadruped()
    for seed in range(seeds):
        friction = FRICTIONS[0] + (FRICTIONS[1] - FRICTIONS[0]) * (seed / (seeds - 1) if seeds > 1 else 0.5)
        robot.clear()
        robot.reset(seed)
        for effect in (f"floor friction={friction}", *effects):
            robot.switch_on(effect)
        rng = random.Random(seed)
        while robot.now_s < 60.0 * minutes and not robot.fallen:
            robot.step(rng.uniform(-V_MAX, V_MAX), rng.uniform(-W_MAX, W_MAX), rng.uniform(0.9, 1.1))
            lean = max(lean, _lean(robot))
        walked += robot.now_s
        if robot.fallen:
            fell.append(f"seed {seed}, friction {friction:.2f}, after {robot.now_s:.1f} s: {robot.fallen}")
    return {"walked_min": walked / 60.0, "fell": fell, "lean_deg": lean, "factor": walked / (time.process_time() - begin)}


def tracking(holds: int, effects: list[str]) -> dict[str, object]:
    """Mean speeds of the body in holds of 6 s, the first second left out, against the commands."""
    robot, rng = Quadruped(seed=1000), random.Random(1000)
    for effect in effects:
        robot.switch_on(effect)
    commands, answers = [], []
    for _ in range(holds):
        v, w = rng.uniform(-V_MAX, V_MAX), rng.uniform(-W_MAX, W_MAX)
        robot.step(v, w, HOLD_S - JUDGED_S)
        forward = turned = 0.0
        before = robot.pose()
        for _ in range(round(10.0 * JUDGED_S)):
            after = robot.step(v, w, 0.1)
            turn = math.remainder(after[2] - before[2], 2.0 * math.pi)
            middle = before[2] + 0.5 * turn
            forward += (after[0] - before[0]) * math.cos(middle) + (after[1] - before[1]) * math.sin(middle)
            turned += turn
            before = after
        commands.append((v, w))
        answers.append((forward / JUDGED_S, turned / JUDGED_S))
    u, y = np.array(commands), np.array(answers)
    found: dict[str, object] = {"holds": holds, "fell": robot.fallen}
    for i, name in enumerate(("v", "w")):
        gain, bias = np.polyfit(u[:, i], y[:, i], 1)
        found[name] = {"gain": float(gain), "bias": float(bias), "largest_deviation": float(np.max(np.abs(y[:, i] - u[:, i])))}
    return found


def _lean(robot: Quadruped) -> float:
    b, c = robot.joints()[4:6]
    return math.degrees(math.acos(1.0 - 2.0 * (b * b + c * c)))


def _misses(walk: dict[str, object], tracked: dict[str, dict[str, float]]) -> list[str]:
    misses = [] if not walk["fell"] else ["falls"]
    if walk["factor"] < FACTOR:
        misses.append(f"factor below {FACTOR:g}")
    for name in ("v", "w"):
        if not GAIN[0] <= tracked[name]["gain"] <= GAIN[1]:
            misses.append(f"gain of {name}")
        if not abs(tracked[name]["bias"]) <= BIAS:
            misses.append(f"bias of {name}")
    return misses


def main() -> int:
    """Exit code."""
    p = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    p.add_argument("--minutes", type=float, default=30.0, help="simulated, for each seed (default %(default)s)")
    p.add_argument("--seeds", type=int, default=5)
    p.add_argument("--holds", type=int, default=60)
    p.add_argument("--effect", action="append", default=[], help="what is wrong with the robot; repeatable")
    p.add_argument("--json", action="store_true", help="one JSON object")
    what = p.add_mutually_exclusive_group()
    what.add_argument("--video", type=Path, metavar="FILE", help="only this: a film of a walk")
    what.add_argument("--frames", type=Path, metavar="FOLDER", help="only this: the film's pictures")
    o = p.parse_args()
    if o.video or o.frames:
        print(film(o.video, o.frames, o.effect))
        return 0
    walk, tracked = falls(o.minutes, o.seeds, o.effect), tracking(o.holds, o.effect)
    misses = [] if o.effect else _misses(walk, tracked)  # type: ignore[arg-type]
    if o.json:
        print(json.dumps({"walk": walk, "tracking": tracked, "misses": misses}))
        return int(bool(misses))
    print(f"walked {walk['walked_min']:.1f} min, {o.seeds} seeds: {len(walk['fell'])} falls; largest lean {walk['lean_deg']:.1f} degrees")
    for fall in walk["fell"]:
        print(f"  {fall}")
    print(f"factor {walk['factor']:.1f} (simulated time over the processor's)")
    for name, unit in (("v", "m/s"), ("w", "rad/s")):
        t = tracked[name]
        print(f"{name}: gain {t['gain']:.3f}, bias {t['bias']:+.4f} {unit}; worst of {o.holds} holds off by {t['largest_deviation']:.4f}")
    print("misses: " + (", ".join(misses) or "none") if not o.effect else "with effects: not judged")
    return int(bool(misses))


if __name__ == "__main__":
    sys.exit(main())
