"""The whole loop on a real autopilot as one command: ArduPilot Rover in its own simulator, the shipped profile and controller, its figures.

    tools/rover_experiment.py [-o FILE.html] [--json FILE] [--sitl FOLDER] [--stories 1] [--minutes 10] [--share 0.4] [--keep FOLDER]

(make rover-experiment.)

A story is what a person would type (`rover_story`): sample, deploy, trace, adopt if a model is proposed, sample again, deploy, drive for
--minutes, then SIM_ENGINE_FAIL and SIM_ENGINE_MUL = --share set by a second MAVLink client, and what the runtime makes of it; in the end
the audit. It runs in real time: some 25 to 40 minutes. --stories N: so many at the same time, each with a simulator and a daemon of its
own. Beside them stands what a bare unicycle would give on the same samples. Where the simulator is: --sitl FOLDER, or S2R_SITL=FOLDER.
Exit 0 if every story was complete, 1 if not.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import subprocess
import sys
import tempfile
import threading
import time
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict
from pathlib import Path
from typing import Any

import rover_figures as figures
from rover_sitl import find_folder
from rover_story import CONTROLLER, PROFILE, Story, Told

from s2r_runtime.errors import S2RError
from s2r_runtime.profile import load_profile


def bare_unicycle(log: Path) -> dict[str, Any]:
    """Gap of the model without its data sheet on a story's first campaign, and whether the controller passes at it."""
    profile = load_profile(PROFILE)
    text = PROFILE.read_text(encoding="utf-8")
    begin, end = text.index("[[model.effects]]"), text.index("\n[region]")
    with tempfile.TemporaryDirectory() as folder:
        bare = Path(folder) / "bare.toml"
        bare.write_text(text[:begin] + text[end:], encoding="utf-8")
        gap = _json("gap", str(log), "--profile", str(bare), "--epsilon", str(profile.guarantee.epsilon))
        if "radius" not in gap:
            return gap
        options = ["--radius", str(gap["radius"])]
        if hold := gap.get("hold_radius"):
            options += ["--hold-radius", str(hold)]
        verified = _json("verify", str(CONTROLLER), "--profile", str(bare), *options)
    return {**gap, "passed": verified.get("passed"), "laws": verified.get("laws")}


def _json(*verb: str) -> dict[str, Any]:
    done = subprocess.run([sys.executable, "-m", "s2r_runtime", *verb, "--json"], capture_output=True, text=True, check=False)
    with contextlib.suppress(json.JSONDecodeError):
        return dict(json.loads(done.stdout))
    return {"error": (done.stderr or done.stdout).strip()[-300:]}


def outcome_lines(stories: list[Told], bare: dict[str, Any]) -> list[str]:
    """What came out, in lines."""
    lines = []
    for told in stories:
        lines.append(f"{told.name}: {'complete' if told.is_complete else 'not complete'}; drove {told.driven_s:.0f} s under a certificate")
        closed = ", ".join(f"{reason} {seconds:.0f} s" for reason, seconds in told.closed.items())
        lines.append(f"  gate closed meanwhile: {closed or 'never'}; false revocation: {told.false_revocation or 'none'}")
        if told.deployed_again:
            lines.append(f"  controller_fault cleared and deployed again {told.deployed_again} times")
        if told.noticed_after_s is not None:
            lines.append(
                f"  fault noticed after {told.noticed_after_s:.1f} s ({told.reason_noticed}); deployed again: refused {told.refused_again}"
            )
        lines.append(f"  audit holds: {told.audit_holds}" + (f"; ended: {told.error}" if told.error else ""))
    if "radius" in bare:
        words = {True: "passes", False: "is refused", None: "was not verified"}[bare.get("passed")]
        lines.append(f"bare unicycle on the same samples: gap {bare['radius']:.4g} m a step; the controller {words} at it")
    return lines


def main(arguments: list[str]) -> int:
    """Exit 0 if every story was complete, 1 if not, 78 without a simulator."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("-o", "--output", type=Path, metavar="FILE.html", help="the figures on one page (needs matplotlib)")
    parser.add_argument("--json", type=Path, metavar="FILE", help="all numbers")
    parser.add_argument(
        "--sitl", type=Path, metavar="FOLDER", help="with ardurover and rover-skid.parm (default: S2R_SITL, ../shared/sitl)"
    )
    parser.add_argument("--stories", type=int, default=1, metavar="N", help="at the same time (default 1)")
    parser.add_argument("--minutes", type=float, default=10.0, help="of driving (default 10)")
    parser.add_argument("--share", type=float, default=0.4, help="of their thrust that the motors still give after the fault (default 0.4)")
    parser.add_argument("--keep", type=Path, metavar="FOLDER", help="profiles, states and logs stay there (default: a temporary folder)")
    given = parser.parse_args(arguments)
    try:
        sitl = find_folder(given.sitl)
    except S2RError as error:
        print(f"rover_experiment: {error}", file=sys.stderr)
        return error.exit_code
    folder = given.keep or Path(tempfile.mkdtemp(prefix="rover-"))
    lock, begin = threading.Lock(), time.monotonic()

    def run(number: int) -> Told:
        def say(line: str) -> None:
            with lock:
                print(f"[{time.monotonic() - begin:6.0f} s, rover {number}] {line}", flush=True)

        return Story((folder / f"rover{number}").resolve(), sitl, number, given.minutes, given.share, say).run()

    with ThreadPoolExecutor(given.stories) as pool:
        stories = list(pool.map(run, range(1, given.stories + 1)))
    logs = next((told.logs for told in stories if told.logs), [])
    bare = bare_unicycle(logs[0]) if logs else {}
    lines = outcome_lines(stories, bare)
    print("\n".join(lines))
    if given.json:
        given.json.write_text(json.dumps({"stories": [asdict(told) for told in stories], "bare": bare}, indent=1, default=str))
    if given.output:
        given.output.write_text(figures.page(stories, bare, lines), encoding="utf-8")
        print(f"figures: {given.output}")
    print(f"logs: {folder}")
    return 0 if all(told.is_complete for told in stories) else 1


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
