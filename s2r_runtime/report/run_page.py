"""A log as one self-contained page: what was measured, shown, decided and driven, with plots and the statements as they stand."""

from __future__ import annotations

from collections.abc import Sequence
from datetime import UTC, datetime
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np

from s2r_runtime.core import stream
from s2r_runtime.core.gaps import GOOD_REFUSED
from s2r_runtime.errors import NotEnoughEvidence
from s2r_runtime.evidence.bounds import anytime_upper
from s2r_runtime.evidence.gap import discrepancy, residuals, statement
from s2r_runtime.evidence.verify import not_shown
from s2r_runtime.messages import REPEATED, Gap, Settings
from s2r_runtime.modelspec import ModelSpec
from s2r_runtime.recording.writer import read_all
from s2r_runtime.report import plots
from s2r_runtime.report.page import Page
from s2r_runtime.report.runs_section import add_runs
from s2r_runtime.report.story import Story, tell
from s2r_runtime.report.trace_section import add_trace

COLOURS = {"good": plots.GREEN, "bad": plots.RED, "plain": plots.SOFT}
SOURCES = {"sampler": (plots.BLUE, "sampler"), "controller": (plots.GREEN, "certified controller"), "recovery": (plots.QUIET, "recovery")}
GATE = {"open": (plots.GREEN, "open"), "closed": (plots.QUIET, "closed")}


def log_page(paths: Sequence[Path]) -> str:
    """The page of a run's files, in order. Raises RecordingError if they are no log, NotEnoughEvidence if they hold no record,
    ConfigError without matplotlib.
    """
    log = read_all(paths)
    story = tell(log.entries())
    if not story.records:
        raise NotEnoughEvidence(f"{', '.join(map(str, paths))}: no record could be read, so there is nothing to report: {log.ending()}")
    name = story.settings.robot if story.settings else "unknown robot"
    when = datetime.fromtimestamp(story.started_unix_s, UTC).strftime("%Y-%m-%d %H:%M UTC")
    length = f"{story.seconds(story.last_ns):.0f} s on the robot's clock"
    page = Page(f"{name}: what this run showed", f"{when} · {story.records} records · {length} · {log.ending()}")
    _summary(page, story)
    _timeline(page, story)
    _gaps(page, story, log.models())
    add_refused(page, story, log.models())
    for number, trace in enumerate(story.traces, 1):
        page.heading(f"Residual traced{f' ({number})' if len(story.traces) > 1 else ''}")
        _made_on(page, trace)
        add_trace(page, trace)
    _verifications(page, story)
    _driving(page, story)
    add_runs(page, story.runs, story.settings)
    _certificates(page, story)
    page.heading("Not shown")
    page.items(not_shown(), "soft")
    return page.html()


def _made_on(page: Page, trace: dict[str, Any]) -> None:
    """Which rows of this log a trace stands for, and what becomes of its model."""
    recording, proposal = trace.get("recording"), trace.get("proposal")
    if not recording or not proposal:
        return
    parts = "; ".join(f"records {part['first']} to {part['last']} of {part['run']}" for part in recording["parts"])
    page.text(
        f"Made on the {recording['stretch']} of epoch {recording['epoch']}: {recording['observations']} observations and "
        f"{recording['commands']} commands, {parts}. Model {trace['model'][7:19]}, seed {trace['seed']}.",
        "soft",
    )
    if proposal["proposed"]:
        page.text(f"It proposes the repaired model {proposal['digest'][7:19]}; adopted, its gap comes from a fresh campaign.")
    elif trace["effects"]:
        page.text(f"It proposes no model: {proposal['reason']}.", "warn")


def _summary(page: Page, story: Story) -> None:
    valid = [c for c in story.certificates if c.id not in dict(story.revoked)]
    last = story.gate[-1] if story.gate else None
    if last is not None:
        page.text(f"The run ends with the gate {'open' if last[1] else 'closed'} ({last[2]}).", "good" if last[1] else "warn")
    counted = [(len(story.gaps), "gap"), (len(story.verifications), "verification attempt"), (len(story.certificates), "certificate")]
    words = [f"{number} {name}{'' if number == 1 else 's'}" for number, name in counted]
    page.text(f"{', '.join(words)}; {len(valid)} still valid at the end.")

    _before_and_after(page, story)


def _before_and_after(page: Page, story: Story) -> None:
    """The loop in one table: what the repair did to the error and to the gap."""
    rows = [
        (f"gap of epoch {g.epoch}: one step / {g.hold_periods} held steps", f"{g.radius:.4g} / {g.hold_radius:.4g}") for g in story.gaps
    ]
    for trace in story.traces:
        named = ", ".join(f"{e['name']}({e['channel']})" for e in trace["effects"]) or trace["verdict"]
        error = trace["error"]
        for state, before in error["before"]["rollout_rms"].items():
            after, unit = error["after"]["rollout_rms"][state], error["unit"].get(state, "")
            label = f"held-out rms of {state} after {error['before']['rollout_horizon_s']:.2g} s, before → after {named}"
            rows.append((label, f"{before:.4g} → {after:.4g} {unit}"))
    if rows:
        page.table(("in short", ""), rows)


def _timeline(page: Page, story: Story) -> None:
    if not story.gate and not story.marks:
        return
    end = story.seconds(story.last_ns)
    page.heading("Who drove, and the gate")
    page.figure(
        plots.timeline(_spans(story.sources, end), _numbered(story, 0.0), SOURCES, "s", "who commanded the robot over time"),
        "Who commanded the robot. Numbers: the list below.",
    )
    opened = [when for when, is_open, _ in story.gate if is_open]
    if opened:
        begin = max(0.0, opened[0] - 1.0)
        spans = [
            (max(b, begin), e, kind) for b, e, kind in _spans([(w, "open" if o else "closed") for w, o, _ in story.gate], end) if e > begin
        ]
        page.figure(
            plots.timeline(spans, _numbered(story, begin), GATE, "s", "gate open and closed while a controller was deployed"),
            "The gate, from just before it first let a controller through.",
        )
    page.items((f"{when:.2f} s: {what}" for when, what, _ in story.marks), "marks")
    if story.refusals:
        page.table(
            ("commands refused because", "number"), [(r, n) for n, r in sorted(((n, r) for r, n in story.refusals.items()), reverse=True)]
        )


def _spans(changes: Sequence[tuple[float, str]], end: float) -> list[tuple[float, float, str]]:
    """(from, to, what) from (when, what from then on)."""
    return [(begin, after, what) for (begin, what), (after, _) in pairwise([*changes, (end, "")])]


def _numbered(story: Story, begin: float) -> list[tuple[float, int, str]]:
    return [(when, number, COLOURS[kind]) for number, (when, _, kind) in enumerate(story.marks, 1) if when >= begin]


def _gaps(page: Page, story: Story, models: dict[str, ModelSpec]) -> None:
    for gap in story.gaps:
        page.heading(f"Gap of epoch {gap.epoch}")
        page.text(statement(gap, independent=True, states=story.settings.states if story.settings else ()), "statement")
        page.table(
            ("radius", "unweighted", "hold gap", "noise alone", "N", "discarded", "ε", "β spent"),
            [
                (
                    f"{gap.radius:.5g}",
                    f"{gap.radius_literal:.5g}",
                    f"{gap.hold_radius:.5g} / {gap.hold_periods} periods",
                    f"{gap.radius_noise:.3g}" if gap.radius_noise else "-",
                    gap.n,
                    gap.discarded,
                    gap.epsilon,
                    f"{gap.beta:.4g}",
                )
            ],
        )
        values = _discrepancies(story, gap, models)
        if values is not None:
            lines = {f"r = {gap.radius:.4g}": (gap.radius, plots.RED)}
            page.figure(
                plots.histogram(values, "discrepancy", lines, f"histogram of {gap.n} discrepancies"),
                f"{gap.n} discrepancies of epoch {gap.epoch}, and the gap",
            )
        if gap.rejected:
            page.text("Samples not taken: " + ", ".join(f"{reason} {number}" for reason, number in sorted(gap.rejected.items())), "soft")


def add_refused(page: Page, story: Story, models: dict[str, ModelSpec]) -> None:
    """Campaigns whose samples depend on each other: what they cost, and what to look at."""
    for gap, seconds in story.refused:
        page.heading(f"Refused campaign of epoch {gap.epoch}")
        page.text(f"No gap: {gap.white_reason}. Its samples were not drawn independently, so they bound nothing.", "bad")
        page.table(("cost: samples", "driven for", "β spent"), [(gap.n, f"{seconds:.0f} s", f"{gap.beta:.4g}")])
        if gap.white_reason.startswith(REPEATED):
            page.text("Look for what plays a recording instead of the robot, and for a sensor that is stuck.")
            continue
        page.text(
            f"The test refuses at most 1 in {GOOD_REFUSED} good campaigns, so one refusal may be chance; repeat it (s2r sample --retry). "
            "Two in a row are hardly chance. Then look below for a trend, and for what changes while the robot samples."
        )
        values = _discrepancies(story, gap, models)
        if values is not None:
            number = np.arange(1.0, len(values) + 1.0)
            page.figure(
                plots.series(
                    {"discrepancy": (number, values, plots.BLUE)}, "sample", "discrepancy", "discrepancies in the order of samples"
                ),
                f"The {len(values)} discrepancies in the order in which they were sampled. Independent ones show no trend.",
            )


def _discrepancies(story: Story, gap: Gap, models: dict[str, ModelSpec]) -> plots.Array | None:
    from s2r_runtime.models.composed import compose
    from s2r_runtime.recordings.loading import from_samples

    spec, samples = models.get(gap.model_digest), story.samples.get(gap.epoch, [])
    if spec is None or not samples:
        return None
    model = compose(spec)
    return discrepancy(residuals(model, from_samples(samples)), np.array(gap.weights), gap.set)


def _verifications(page: Page, story: Story) -> None:
    for verification, safety in story.verifications:
        verdict = "passed" if verification.passed else "failed"
        page.heading(f"Verification attempt {verification.attempt}: {verdict}")
        page.text(
            verification.reason or f"Every required law passed at radius {verification.radius:.4g}.",
            "good" if verification.passed else "bad",
        )
        if verification.tried:
            page.text(
                f"Looked at, of {verification.split} radii that were fixed beforehand and share the attempt's beta: "
                + "; ".join(f"{one.radius:.4g} {'passed' if one.passed else 'failed'}" for one in verification.tried)
                + ".",
                "soft",
            )
        page.table(
            ("law", "scenarios", "s*", "failures", "P(failure) at most", "progress", ""),
            [
                (
                    r.law,
                    r.n,
                    f"{r.s_star:+.4f}",
                    r.failures,
                    f"{r.failure_upper:.2%}",
                    f"{r.progress:.3f}",
                    "required" if r.required else "reported",
                )
                for r in verification.laws
            ],
        )
        if safety:
            page.figure(
                plots.histograms(safety, "safety value", verification.threshold, f"safety values of attempt {verification.attempt}"),
                f"Safety values of attempt {verification.attempt}; red: the threshold.",
            )


def _driving(page: Page, story: Story) -> None:
    if not any(row[2] for row in story.poses.rows):
        return
    page.heading("Driving")
    settings = story.settings
    if settings is not None and {"x", "y"} <= set(settings.states):
        _path(page, story, settings)
    if story.discrepancies.rows:
        rows = np.array(story.discrepancies.rows)
        t = rows[:, 0]
        page.figure(
            plots.series(
                {
                    "discrepancy": (t, rows[:, 1], plots.BLUE),
                    "radius": (t, rows[:, 3], plots.ORANGE),
                    "verified radius": (t, rows[:, 4], plots.RED),
                },
                "s",
                "discrepancy",
                "discrepancy over time with the radius in force and the verified one",
            ),
            "What the watch saw while the controller drove.",
        )
        page.figure(
            plots.series({"e-value": (t, np.maximum(rows[:, 2], 1e-12), plots.INK)}, "s", "e-value", "e-value over time", log=True),
            "Evidence that the gap is exceeded too often; an alarm at 1/α.",
        )
        _watched(page, story)
    if story.episodes:
        page.table(
            ("scenario", "steps", "safety value", "progress", ""),
            [(e.index, e.steps, f"{e.safety:+.3f}", f"{e.progress:.3f}", e.detail) for e in story.episodes],
        )


def _watched(page: Page, story: Story) -> None:
    """What driving shows of itself, by bounds that hold however often one looks (guarantee G5)."""
    seen = [(epoch, gap, stood) for epoch, (gap, stood) in story.watched.items() if stood.n]
    if not seen or story.settings is None:
        return
    alpha = story.settings.alpha
    quantiles = {epoch: stream.quantile(stood.counts, gap.radius, gap.epsilon, alpha) for epoch, gap, stood in seen}
    page.table(
        ("epoch", "discrepancies", "above r", "share above r is at most", "all but ε are at most", "change", "of one law"),
        [
            (
                epoch,
                stood.n,
                stood.exceedances,
                f"{anytime_upper(stood.exceedances, stood.n, alpha):.3g}",
                "-" if quantiles[epoch] is None else f"{quantiles[epoch]:.4g} ({gap.epsilon:g})",
                f"{stood.change:.3g} of {story.settings.run_length:g}",
                "refuted" if stood.exchange >= 1.0 / alpha else f"{stood.exchange:.3g} of {1.0 / alpha:g}",
            )
            for epoch, gap, stood in seen
        ],
    )
    page.text(
        f"The two bounds hold with confidence {1.0 - alpha:g} each, at all times at once. They found no gap: driving is not independent."
    )


def _path(page: Page, story: Story, settings: Settings) -> None:
    ix, iy = settings.states.index("x"), settings.states.index("y")
    rows = [row for row in story.poses.rows if len(row[1]) == len(settings.states)]
    x, y = np.array([row[1][ix] for row in rows]), np.array([row[1][iy] for row in rows])
    driven = np.array([row[2] for row in rows], dtype=bool)
    page.figure(plots.path(x, y, driven, "x, m", "y, m", "path of the robot"), "Where the robot went.")


def _certificates(page: Page, story: Story) -> None:
    if not story.certificates:
        return
    page.heading("Certificates")
    revoked = dict(story.revoked)
    page.table(
        ("id", "controller", "epoch", "gap", "certified to", "state"),
        [
            (
                c.id[7:19],
                c.controller_digest[7:19],
                c.epoch,
                f"{c.radius:.4g}",
                f"{c.verified_radius:.4g}",
                f"revoked: {revoked[c.id]}" if c.id in revoked else "valid",
            )
            for c in story.certificates
        ],
    )
