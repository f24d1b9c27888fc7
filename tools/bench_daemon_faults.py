"""Faults in running daemons: real processes and a real transport, as many faults as asked for, and a driving controller between two.

    python tools/bench_daemon_faults.py --count 500 [--seed 1] [--only NAME] [--json FILE]
    python tools/bench_daemon_faults.py --link zenoh|mavlink|can --quick

Without --link the robot is on a socket of its own, where a transport can be sabotaged too. tests/daemon_faults.py says what the faults are:
controllers that raise, hang, leak, fork, print, exit; processes killed and stopped; a full, slow and dead recorder; states cut, flipped,
another robot's, from the future; clocks that step; a link that is lost, lies or commands; people who stop, revoke and mistype. With --link
the robot is at the end of that link, and tests/link_faults.py says what befalls it. Every fault must be noticed with a reason of the gate's
table (or do nothing at all, where that is right), and a certified controller must drive again. Each daemon's logs are judged afterwards.
Exit 1 if one case does not hold.
"""

from __future__ import annotations

import argparse
import json
import random
import shutil
import sys
import tempfile
import time
from collections import Counter, defaultdict
from collections.abc import Iterable
from pathlib import Path

ROOT = Path(__file__).parent.parent
sys.path.insert(0, str(ROOT / "tests" / "rigs"))

import daemon_rig  # noqa: E402
import link_faults  # noqa: E402
from daemon_faults import AGAIN_S, FAULTS, Drill, judged  # noqa: E402

daemon_rig.WITHIN_S = AGAIN_S  # a bench may run beside anything


def plan(faults: Iterable[str], count: int, seed: int, only: str) -> list[str]:
    """Every fault as often as any other, in an order of its own each time."""
    names = [name for name in faults if only in name]
    draw, found = random.Random(seed), []
    while len(found) < count:
        found += draw.sample(names, len(names))
    return found[:count]


def life(
    names: list[str], seed: int, link: str, rows: dict[str, list[float]], reasons: dict[str, Counter[str]]
) -> tuple[Counter[str], list[str]]:
    """One robot and its faults: what was counted, and what did not hold."""
    folder = Path(tempfile.mkdtemp(prefix="faults"))
    count: Counter[str] = Counter()
    wrong: list[str] = []
    drill = link_faults.LinkDrill(folder, link, seed) if link else Drill(folder, seed=seed)
    try:
        drill.begin()
        for name in names:
            try:
                outcome = drill.run(name)
            except Exception as error:  # noqa: BLE001 - whatever it is, the case does not hold, and the others go on
                wrong.append(f"{name}: {type(error).__name__}: {str(error)[:200]} ... {str(error)[-700:]}")
                print(wrong[-1], flush=True)
                drill.drive()
                continue
            rows[name].append(outcome.seconds)
            reasons[name].update(outcome.reasons)
        drill.rig.stop()
        count.update(link_faults.judged(drill) if isinstance(drill, link_faults.LinkDrill) else judged(drill))
    except Exception as error:  # noqa: BLE001 - as above
        wrong.append(f"a life ended: {type(error).__name__}: {str(error)[:1000]}")
        print(wrong[-1], f"(kept in {folder})", flush=True)
    else:
        shutil.rmtree(folder, ignore_errors=True)
    finally:
        drill.rig.close()
    return count, wrong


def main() -> int:
    """0 if every fault ended as it must, 1 otherwise."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--count", type=int, default=500)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--only", default="", help="only faults whose name contains this")
    parser.add_argument("--link", choices=link_faults.KINDS, default="", help="over this transport; else over a socket of the rig's own")
    parser.add_argument("--quick", action="store_true", help="each fault once")
    parser.add_argument("--minutes", type=float, default=1e9, help="begin no further life after so long")
    parser.add_argument("--json", type=Path, help="write what came of it there")
    options = parser.parse_args()
    faults = link_faults.LINK_FAULTS if options.link else FAULTS
    in_one_life = len(faults)  # in one robot's folder, before it is judged and a new one begins
    names = plan(faults, in_one_life if options.quick else options.count, options.seed, options.only)
    rows: dict[str, list[float]] = defaultdict(list)
    reasons: dict[str, Counter[str]] = defaultdict(Counter)
    count: Counter[str] = Counter()
    wrong: list[str] = []
    begun = time.monotonic()
    for index in range(0, len(names), in_one_life):
        if time.monotonic() - begun > 60.0 * options.minutes:
            break
        found, failed = life(names[index : index + in_one_life], options.seed + index, options.link, rows, reasons)
        count += found
        wrong += failed
        held = sum(map(len, rows.values()))
        print(f"{held} of {len(names)} faults held, {len(wrong)} did not; {time.monotonic() - begun:.0f} s", file=sys.stderr, flush=True)
    print(f"{'fault':36s} times  drives again after (median, worst)  reasons that the gate gave")
    for name, seconds in sorted(rows.items()):
        times = sorted(seconds)
        said = ", ".join(reason for reason, _ in reasons[name].most_common())
        print(f"{name:36s} {len(times):5d}  {times[len(times) // 2]:6.1f} s {times[-1]:6.1f} s  {said or '(drives on)'}")
    print(
        f"{sum(map(len, rows.values()))} faults held, {len(wrong)} did not; {count['commands']} commands reached the robot, "
        f"{count['events']} events judged; {time.monotonic() - begun:.0f} s"
    )
    if options.json:
        options.json.write_text(json.dumps({"rows": rows, "reasons": reasons, "counts": count, "wrong": wrong}, indent=1))
    return 1 if wrong else 0


if __name__ == "__main__":
    raise SystemExit(main())
