"""The pages, opened in a real headless Chromium: complete, self-contained, nothing fetched, nothing cut off."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from pages_rig import needs_chromium, rendered, self_contained

from s2r_runtime.report import plots
from s2r_runtime.report.page import Page


def sample_page() -> str:
    page = Page("A <robot> & its gap", "subtitle")
    rng = np.random.default_rng(1)
    values = rng.rayleigh(0.001, 300)
    page.figure(plots.histogram(values, "discrepancy, m", {"r": (float(values.max()), plots.RED)}, "histogram"), "a histogram")
    t = np.arange(200) * 0.033
    page.figure(
        plots.series(
            {"before": (t, rng.normal(size=200), plots.ORANGE), "after": (t, rng.normal(size=200) / 5, plots.BLUE)},
            "s",
            "residual",
            "a series",
        ),
        "a series",
    )
    spans = [(0.0, 2.0, "closed"), (2.0, 5.0, "open"), (5.0, 6.0, "closed")]
    marks = [(2.0, 1, plots.GREEN), (5.0, 2, plots.RED)]
    page.figure(plots.timeline(spans, marks, {"open": (plots.GREEN, "open"), "closed": (plots.SOFT, "closed")}, "s", "gate"), "the gate")
    page.table(("a", "b"), [(1, "<b>not bold</b>")])
    return page.html()


@pytest.mark.slow
@needs_chromium
def test_a_page_renders_with_its_figures_and_fetches_nothing(tmp_path: Path) -> None:
    path = tmp_path / "page.html"
    path.write_text(sample_page(), encoding="utf-8")
    self_contained(path.read_text(encoding="utf-8"))
    dom = rendered(path, tmp_path)
    assert dom.count("<svg") == 3
    assert "A &lt;robot&gt; &amp; its gap" in dom
    assert "<b>not bold</b>" not in dom


def test_the_same_numbers_give_the_same_page() -> None:
    assert sample_page() == sample_page()


def test_a_figure_of_nothing_is_still_a_figure() -> None:
    assert "<svg" in plots.histogram([], "x", {}, "empty")
    assert "<svg" in plots.histograms({}, "x", 0.0, "empty")
    assert "<svg" in plots.series({}, "s", "y", "empty")
