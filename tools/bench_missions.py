"""Whole missions by repetition (guarantee G4, G5): how often a certificate was issued that says what is not so, and how often a good one.

    tools/bench_missions.py [--missions 2000] [--samples 60000] [--seed 1] [--quick] [--json]

A mission: a campaign, controllers most of which are just too bad, the good one at last, then driving, at which watch and core look after
every sample; the radius grows, verification runs again, an alarm calls for another campaign. The discrepancies are |z|, z an autoregression
of order 1 that runs through campaign and driving alike: independent draws at rho = 0, anything but at rho = .98. The core, the gap and the
watch are the real ones, through their public functions; the e-values of all missions side by side are those of `watch.EProcess` vectorised,
and compared with it.

The planted faults are what naive versions do; each must be caught by the same count. Then: how soon a change is noticed and how seldom
falsely, what the watch costs, how soon growth closes the gate, what a re-verification costs.

A promise is broken if the exact 99.9 % lower limit of the rate of missions with a false certificate exceeds beta. Exit 1 if a promise is
broken, a fault is not caught or a figure is missed.
"""

from __future__ import annotations

import argparse
import json
import math
import resource
import sys
import time
from collections.abc import Iterator
from copy import copy
from pathlib import Path
from typing import Any, NamedTuple

import msgspec
import numpy as np
from missions import Life, profile_and_settings
from numpy.typing import NDArray
from scipy.signal import lfilter
from scipy.special import erf

from s2r_runtime.controllers.hosted import batch_control, load
from s2r_runtime.core import reducer as core
from s2r_runtime.core.ledger import share
from s2r_runtime.core.stream import bin_of
from s2r_runtime.daemon.analytics import Analytics, Reply, Watching
from s2r_runtime.evidence.bounds import anytime_discards, clopper_pearson_lower, clopper_pearson_upper, sample_size, scenario_confidence
from s2r_runtime.evidence.uncertain import GapSet
from s2r_runtime.evidence.verify import verify_in_detail
from s2r_runtime.evidence.watch import ChangeDetector, ConformalTest, EProcess
from s2r_runtime.evidence.watch.exceedance import GRID, grid
from s2r_runtime.messages import GateChanged, Observation, Send, Settings
from s2r_runtime.models.composed import compose
from s2r_runtime.plugins import registry
from s2r_runtime.profile import load_profile

Array = NDArray[np.float64]

RHOS = (0.0, 0.2, 0.3, 0.4, 0.5, 0.7, 0.9, 0.98)
"""Around .3 dependence is not always seen; from .7 on it hurts."""
CAMPAIGNS = 5
"""A person tries so often before giving up on a robot whose campaigns are refused."""
CONTROLLERS = ("bad 1", "bad 2", "bad 1", "bad 2", "good")
"""Tried in this order until one passes."""
TOO_BAD = 1.02
"""Failure probability of a bad controller, in epsilon: just on the wrong side, where passing is likeliest."""
GROWN = 1.5
"""Regime change: all discrepancies grow by so much in the middle of the mission."""
SURE, BLOCK = 1e-3, 500
DETECT_EPSILON, DETECT_RATE, RUN_LENGTH, QUIET = 0.005, 0.05, 1e5, 3000


class Row(NamedTuple):
    """One count. planted: a fault that must be caught rather than a promise that must hold."""

    what: str
    missions: int
    false: int
    lower: float
    beta: float
    planted: bool = False
    certified: int = -1
    """Missions that hold a certificate after the campaign."""
    at_end: int = -1
    refused: int = 0
    """Campaigns refused."""

    @property
    def ok(self) -> bool:
        """Whether it came out as it must."""
        return (self.lower > self.beta) == self.planted


def violation(r: float, scale: float = 1.0) -> float:
    """P(scale |z| > r), z standard normal."""
    return float(1.0 - erf(r / scale / math.sqrt(2.0)))


class Autoregression:
    """(m,) standard normal autoregressions, side by side."""

    def __init__(self, m: int, rho: float, rng: np.random.Generator) -> None:
        self._rho, self._rng, self._z = rho, rng, rng.normal(size=m)

    def draw(self, n: int, rows: NDArray[np.int64] | slice = slice(None)) -> Array:
        """(m or len(rows), n): the next n of all, or of some while the others wait."""
        last = self._z[rows]
        w = self._rng.standard_normal((len(last), n))
        if self._rho:
            w *= math.sqrt(1.0 - self._rho**2)
            w, _ = lfilter([1.0], [1.0, -self._rho], w, axis=1, zi=self._rho * last[:, None])
        self._z[rows] = w[:, -1]
        return w


class Watches:
    """`EProcess` of m missions side by side, in plain numbers: what is far below 1 may vanish, what is above LIMIT has alarmed."""

    LIMIT = 1e200

    def __init__(self, m: int, epsilon: float) -> None:
        p = np.array(grid(epsilon))
        self._factors = np.array([(1.0 - p) / (1.0 - epsilon), p / epsilon])
        self.won, self.n, self.exceedances = np.zeros((m, GRID)), np.zeros(m, dtype=np.int64), np.zeros(m, dtype=np.int64)

    def begin(self, row: int) -> None:
        """A gap came into force there."""
        self.won[row], self.n[row], self.exceedances[row] = 0.0, 0, 0

    def of(self, rows: NDArray[np.int64]) -> Watches:
        """Those of some missions, to go on with; `put` brings them back."""
        some = copy(self)
        some.won, some.n, some.exceedances = self.won[rows], self.n[rows], self.exceedances[rows]
        return some

    def put(self, rows: NDArray[np.int64], some: Watches) -> None:
        """Takes them back."""
        self.won[rows], self.n[rows], self.exceedances[rows] = some.won, some.n, some.exceedances

    def update(self, exceeds: NDArray[np.bool_]) -> Array:
        """(m,) e-values after one more sample each."""
        self.n += 1
        self.exceedances += exceeds
        log_n, log_next = np.log(self.n), np.log1p(self.n)
        self.won += (np.log1p(1.0 / self.n) / ((1.0 + log_n) * (1.0 + log_next)) / GRID)[:, None]
        self.won *= self._factors[exceeds.astype(np.intp)]
        np.minimum(self.won, self.LIMIT, out=self.won)
        return np.asarray(1.0 / (1.0 + log_next) + self.won.sum(axis=1))


# ---------------------------------------------------------------- missions


def missions(m: int, samples: int, rho: float, seed: int, *, change: bool = False, apart: bool = False) -> Row:
    """m missions. change: the robot becomes GROWN times as wrong in the middle, and a campaign follows the alarm. apart: the samples of a
    campaign are independent, as those after a random waypoint and a full stop are meant to be, and only the driving is not.
    """
    _, model, settings = profile_and_settings()
    rng = np.random.default_rng([seed, round(1000 * rho), 2 * apart + change])
    z = Autoregression(m, rho, rng)
    failure = {"bad 1": TOO_BAD * settings.epsilon, "bad 2": TOO_BAD * settings.epsilon, "good": 0.0}
    lives = [Life(settings, model, rng, dict(failure)) for _ in range(m)]
    scales: list[dict[int, float]] = [{} for _ in lives]
    watches, campaigns = Watches(m, settings.epsilon), Autoregression(m, 0.0, rng) if apart else z
    for index in range(m):
        certify(lives, campaigns, watches, index, 1.0, scales[index])
    certified = sum(life.certified for life in lives)
    drive(lives, z, watches, samples // 2, 1.0, settings)
    if change:
        drive(lives, z, watches, samples // 4, GROWN, settings)
        for index, life in enumerate(lives):
            if life.gap is None:
                certify(lives, z, watches, index, GROWN, scales[index])
    drive(lives, z, watches, samples - samples // 2 - (samples // 4 if change else 0), GROWN if change else 1.0, settings)
    false = sum(
        life.false_certificates(lambda r, epoch, own=own: violation(r, own[epoch])) > 0 for life, own in zip(lives, scales, strict=True)
    )
    name = "independent" if rho == 0.0 else f"AR(1), rho {rho:g}" + (", independent campaigns" if apart else "")
    return Row(
        name + (f", {GROWN:g} times as wrong half-way" if change else ""),
        m,
        false,
        clopper_pearson_lower(false, m, SURE),
        settings.beta,
        False,
        certified,
        sum(life.certified for life in lives),
        sum(life.refused for life in lives),
    )


def certify(lives: list[Life], z: Autoregression, watches: Watches, index: int, scale: float, scales: dict[int, float]) -> None:
    """Campaigns until one founds a gap, then controllers until one passes."""
    life, row = lives[index], np.array([index])
    for _ in range(CAMPAIGNS):
        n = life.begin_campaign()
        scales[life.state.memory.epochs] = scale
        if life.end_campaign(scale * z.draw(n, row)[0]):
            break
    else:
        return
    watches.begin(index)
    any(life.deploy(controller) for controller in CONTROLLERS)


def drive(lives: list[Life], z: Autoregression, watches: Watches, samples: int, scale: float, settings: Settings) -> None:
    """All that hold a certificate drive; whatever changes something for a core is told to it when it happens."""
    driving = [index for index, life in enumerate(lives) if life.certified and life.gap is not None]
    if not driving:
        return
    rows = np.array(driving)
    r = np.array([lives[i].gap.radius for i in driving])  # type: ignore[union-attr]
    top = np.array([lives[i].state.memory.radius for i in driving])
    some, alive, bar = watches.of(rows), np.ones(len(driving), dtype=bool), 1.0 / settings.alpha
    for begin in range(0, samples, BLOCK):
        d = np.abs(z.draw(min(BLOCK, samples - begin), rows)) * scale
        above = d > r[:, None]
        for k in range(d.shape[1]):
            e = some.update(above[:, k])
            for j in np.flatnonzero(alive & ((d[:, k] > top) | (e >= bar))):
                lives[driving[j]].measured(float(d[j, k]), float(e[j]), int(some.n[j]), int(some.exceedances[j]))
                top[j], alive[j] = max(top[j], d[j, k]), e[j] < bar
    watches.put(rows, some)


# ---------------------------------------------------------------- naive versions, which must be caught


def naive(m: int, samples: int, seed: int) -> Iterator[Row]:
    """What the same missions give without paying for looks, windows, dependence and retries."""
    _, _, settings = profile_and_settings()
    epsilon, beta, rng = settings.epsilon, settings.beta, np.random.default_rng([seed, 7])
    n0 = sample_size(epsilon, beta)
    for what, discards, planted in (
        ("fault: a fixed-size bound, read after every sample", _fixed_discards, True),
        ("the same reading of the anytime bound", anytime_discards, False),
    ):
        yield _row(what, _ever_wrong(m, samples, discards, epsilon, beta, rng), beta, planted=planted)
    gaps = np.zeros(m, dtype=np.int64)
    wrong = np.zeros(m, dtype=bool)
    for begin in range(0, samples, BLOCK):
        for column in (rng.random((m, min(BLOCK, samples - begin))) < epsilon).T:
            gaps = np.where(column, 0, gaps + 1)
            wrong |= gaps >= n0
    yield _row("fault: the largest of a sliding window", wrong, beta, planted=True)
    largest = np.abs(Autoregression(m, 0.98, rng).draw(n0)).max(axis=1)
    yield _row(
        "fault: AR(1) samples taken as independent, rho 0.98", np.array([violation(r) > epsilon for r in largest]), beta, planted=True
    )
    passed = rng.binomial(sample_size(epsilon, beta), TOO_BAD * epsilon, (m, 50)) == 0
    yield _row("fault: 50 attempts at beta each", passed.any(axis=1), beta, planted=True)


def ten_controllers(m: int, seed: int) -> Row:
    """Ten controllers that are just too bad, tried until one passes."""
    _, model, settings = profile_and_settings()
    rng = np.random.default_rng([seed, 8])
    names = [f"c{i}" for i in range(10)]
    passed = np.zeros(m, dtype=bool)
    for index in range(m):
        life = Life(settings, model, rng, dict.fromkeys(names, (1.0 + 1e-9) * settings.epsilon))
        n = life.begin_campaign()
        while not life.end_campaign(rng.standard_normal(n)):
            n = life.begin_campaign()
        passed[index] = any(life.deploy(name) for name in names)
    return _row("10 controllers tried until one passes", passed, settings.beta)


def _fixed_discards(n: int, epsilon: float, beta: float) -> int:
    """The largest k with which n samples, had n been fixed, would carry the statement; -1: none."""
    low, high = -1, n
    while high - low > 1:
        middle = (low + high) // 2
        low, high = (middle, high) if scenario_confidence(n, middle, epsilon) <= beta else (low, middle)
    return low


def _ever_wrong(m: int, samples: int, discards: Any, epsilon: float, beta: float, rng: np.random.Generator) -> NDArray[np.bool_]:
    """(m,) whether the (k_n+1)-th largest is ever below the (1-epsilon)-quantile: whether at most k_n are above that."""
    allowed = np.array([discards(n, epsilon, beta) for n in range(1, samples + 1)])
    above, wrong = np.zeros((m, 1), dtype=np.int64), np.zeros(m, dtype=bool)
    for begin in range(0, samples, BLOCK):
        count = above + np.cumsum(rng.random((m, min(BLOCK, samples - begin))) < epsilon, axis=1)
        wrong |= (count <= allowed[begin : begin + count.shape[1]]).any(axis=1)
        above = count[:, -1:]
    return wrong


def _row(what: str, wrong: NDArray[np.bool_], beta: float, *, planted: bool = False) -> Row:
    false = int(np.count_nonzero(wrong))
    return Row(what, len(wrong), false, clopper_pearson_lower(false, len(wrong), SURE), beta, planted)


# ---------------------------------------------------------------- figures


class Figure(NamedTuple):
    """One figure and what it must reach: at most, or at least."""

    what: str
    value: float
    unit: str
    target: float
    at_least: bool = False

    @property
    def ok(self) -> bool:
        """Whether it does."""
        return self.value >= self.target if self.at_least else self.value <= self.target


def detection(runs: int, samples: int, seed: int) -> Iterator[Figure]:
    """How soon a change from .5 % to 5 % is noticed, and how seldom one where there is none."""
    rng, delays = np.random.default_rng([seed, 9]), []
    for _ in range(runs):
        detector = ChangeDetector(DETECT_EPSILON, RUN_LENGTH)
        for exceeds in (rng.random(QUIET) < DETECT_EPSILON).tolist():
            detector.update(exceeds)
        delay = 1
        while detector.update(bool(rng.random() < DETECT_RATE)) < RUN_LENGTH:
            delay += 1
        delays.append(delay)
    yield Figure("a change from 0.5 % to 5 % is noticed after (median)", float(np.median(delays)), "samples", 120.0)
    sums, notices, side = np.zeros((GRID, 2000)), 0, np.array(grid(DETECT_EPSILON))[:, None]
    up, down = side / DETECT_EPSILON, (1.0 - side) / (1.0 - DETECT_EPSILON)
    for _ in range(samples):
        sums += 1.0 / GRID
        sums *= np.where(rng.random(2000) < DETECT_EPSILON, up, down)
        over = sums.sum(axis=0) >= RUN_LENGTH
        notices += int(np.count_nonzero(over))
        sums[:, over] = 0.0
    # an upper limit of the number of notices: they are rare and nearly independent, Poisson by Chernoff at 99.9 %
    most = notices + math.sqrt(2.0 * (notices + 1.0) * math.log(1.0 / SURE)) + math.log(1.0 / SURE)
    yield Figure(
        "samples between false notices of change (99.9 % lower limit)", 2000.0 * samples / most, "samples", 0.99 * RUN_LENGTH, True
    )


def cost(updates: int) -> Iterator[Figure]:
    """Of the three tests together, at the start and after `updates`."""
    rng = np.random.default_rng(1)
    d = np.abs(rng.normal(size=100_000)).tolist()
    tests = EProcess(0.01), ChangeDetector(0.01, RUN_LENGTH), ConformalTest(1, 0.01)

    def update(one: float) -> None:
        exceeds = one > 2.6
        tests[0].update(exceeds)
        tests[1].update(exceeds)
        tests[2].update(bin_of(one, 2.6))

    def timed() -> tuple[float, float]:
        took = []
        for one in d:
            began = time.perf_counter_ns()
            update(one)
            took.append(time.perf_counter_ns() - began)
        return float(np.mean(took)) * 1e-3, float(np.percentile(took, 99)) * 1e-3

    for one in d:
        update(one)
    first, before = timed(), resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    while tests[0].n < updates:
        for one in d:
            update(one)
    last, after = timed(), resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    for when, (mean, p99) in (("", first), (f" after {tests[0].n:.0e}", last)):
        yield Figure(f"update of the watch{when}, mean", mean, "µs", 20.0)
        yield Figure(f"update of the watch{when}, 99 %", p99, "µs", 50.0)
    yield Figure(f"memory that {updates:.0e} updates take", (after - before) / 1024.0, "MB", 1.0)


def vectorised_is_the_watch(seed: int) -> Figure:
    """Largest relative difference between `Watches` and `EProcess` on some streams."""
    rng, worst = np.random.default_rng([seed, 10]), 0.0
    watches, ones = Watches(5, 0.03), [EProcess(0.03) for _ in range(5)]
    rates = np.array([0.0, 0.01, 0.03, 0.06, 0.1])
    for _ in range(3000):
        exceeds = rng.random(5) < rates
        e = watches.update(exceeds)
        for j, one in enumerate(ones):
            worst = max(worst, abs(one.update(bool(exceeds[j])) / e[j] - 1.0) if e[j] < 1e150 else 0.0)
    return Figure("vectorised e-values differ from the watch's by (relative)", worst, "", 1e-6)


def closing(instants: int) -> Figure:
    """From the observation that shows growth to the core's recovery command: the analytics process, the core, no network."""
    profile, model, settings = profile_and_settings()
    life = Life(settings, model, np.random.default_rng(1), {"good": 0.0})
    life.end_campaign(np.random.default_rng(2).normal(size=life.begin_campaign()))
    assert life.deploy("good")
    assert life.gap is not None
    for _ in range(8):
        life.see()
    assert life.state.gate_open
    driving, dt, took = life.state, settings.dt_ns, []
    analytics = Analytics(profile, "mission.toml")
    try:
        analytics.facts()
        for k in range(0, 2 * instants, 2):
            analytics.watch(Watching(profile.model, life.gap, 0.0))
            analytics.observed(Observation(k, k * dt, (0.0, 0.0, 0.0)))
            analytics.sent(Send(0, k + 1, "controller", (0.0, 0.0), k, dt))
            analytics.wait()
            began = time.perf_counter_ns()
            analytics.observed(Observation(k + 1, (k + 1) * dt, (1e3, 0.0, 0.0)))
            reply = next(one for one in analytics.wait() if isinstance(one, Reply))
            assert reply.measured is not None
            _, outputs = core.handle(driving, msgspec.structs.replace(reply.measured, t_ns=life.t, epoch=life.gap.epoch))
            took.append((time.perf_counter_ns() - began) * 1e-6)
            assert any(isinstance(output, GateChanged) and not output.open for output in outputs)
            assert any(isinstance(output, Send) and output.source == "recovery" for output in outputs)
    finally:
        analytics.stop()
    return Figure("from an observation that shows growth to the closed gate (99 %)", float(np.percentile(took, 99)), "ms", 100.0)


def reverification() -> Figure:
    """CPU of verifying the grid controller under three laws at the second attempt's share, as the worker does it, without the start of its
    process.
    """
    root = Path(__file__).parent.parent
    profile = load_profile(root / "profiles" / "robotarium.toml")
    settings, file, model = profile.verification, load(root / "controllers" / "grid.py", {}), compose(profile.model)
    task = registry().get("tasks", profile.task.name)(profile.task.parameters, model.nominal, model.dt)
    control, took = batch_control(file, len(model.inputs)), []
    for _ in range(3):
        began = time.process_time()
        found, _ = verify_in_detail(
            control,
            task,
            model,
            gap_set=GapSet("ball", (1.0, 1.0, 0.0525), 1.5 * 0.0025, 1.5 * 0.005, 50),
            laws=settings.laws,
            required=settings.required,
            n=settings.n,
            epsilon=settings.epsilon,
            beta=share(profile.guarantee.beta, 2),
            threshold=settings.threshold,
            seed=1,
            attempt=2,
            controller_digest=file.digest,
            task_digest=profile.task_digest(),
        )
        took.append(time.process_time() - began)
    return Figure(f"re-verification, {len(found.laws)} laws, grid task (of three the least)", min(took), "s of CPU", 1.0)


# ---------------------------------------------------------------- all of it


def main(arguments: list[str]) -> int:
    """Runs all and prints a table, or JSON."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--missions", type=int, default=2000)
    parser.add_argument("--samples", type=int, default=60_000)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--quick", action="store_true", help="a smoke run: 40 missions of 2000 samples")
    parser.add_argument("--json", action="store_true")
    given = parser.parse_args(arguments)
    m, samples = (40, 2000) if given.quick else (given.missions, given.samples)
    began = time.process_time()
    rows = [told(missions(m, samples, rho, given.seed), given) for rho in RHOS]
    rows.append(told(missions(m, samples, 0.98, given.seed, apart=True), given))
    rows.append(told(missions(m, samples, 0.0, given.seed, change=True), given))
    rows.append(told(ten_controllers(m, given.seed), given))
    rows += [told(one, given) for one in naive(m, samples, given.seed)]
    iid = rows[0]
    held = [Figure("independent missions that hold a certificate after the campaign", 100.0 * iid.certified / m, "%", 90.0, True)]
    held.append(Figure("independent missions that hold one at the end", 100.0 * iid.at_end / m, "%", 90.0, True))
    lower = 100.0 * (1.0 - clopper_pearson_upper(m - iid.certified, m, SURE))
    held.append(Figure("the first of these, 99.9 % lower limit", lower, "%", 90.0, True))
    figures = [told(one, given) for one in held]
    figures.append(told(vectorised_is_the_watch(given.seed), given))
    figures += [told(one, given) for one in detection(40 if given.quick else 1000, samples, given.seed)]
    figures += [told(one, given) for one in cost(200_000 if given.quick else 10_000_000)]
    figures.append(told(closing(20 if given.quick else 300), given))
    figures.append(told(reverification(), given))
    # a smoke run has too few missions to catch the weaker faults, and too few samples for a run length
    ok = all(row.ok or (given.quick and row.planted) for row in rows) and (given.quick or all(figure.ok for figure in figures))
    seconds = time.process_time() - began
    if given.json:
        print(json.dumps({"ok": ok, "cpu_s": seconds, "missions": [r._asdict() for r in rows], "figures": [f._asdict() for f in figures]}))
    else:
        print(f"{seconds:.0f} s of CPU")
    return 0 if ok else 1


def told(one: Any, given: argparse.Namespace) -> Any:
    """Prints it as soon as it is known."""
    if given.json:
        return one
    if isinstance(one, Figure):
        verdict = "" if one.ok else "  MISSED"
        print(f"{one.what:66s} {one.value:12.4g} {one.unit} ({'>=' if one.at_least else '<='} {one.target:g}){verdict}", flush=True)
        return one
    verdict = ("caught" if one.ok else "NOT CAUGHT") if one.planted else ("holds" if one.ok else "BROKEN")
    also = f"  certified {one.certified / one.missions:.2%}, at the end {one.at_end / one.missions:.2%}, {one.refused} campaigns refused"
    rate = f"false {one.false / one.missions:7.2%}, 99.9 % lower limit {one.lower:7.2%}, beta {one.beta:.0%}"
    print(f"{one.what:50s} {one.missions} missions  {rate}  {verdict}{also if one.certified >= 0 else ''}", flush=True)
    return one


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
