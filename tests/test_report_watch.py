"""The report's table of what driving shows: the numbers that the status has, epoch by epoch."""

from __future__ import annotations

from types import SimpleNamespace

from report_rig import Answered

from s2r_runtime.core import reducer as core
from s2r_runtime.evidence.bounds import anytime_upper
from s2r_runtime.messages import Measured
from s2r_runtime.report.page import Page
from s2r_runtime.report.run_page import _watched
from s2r_runtime.report.story import tell


def test_the_report_shows_what_driving_shows_under_each_gap() -> None:
    rig = Answered()
    rig.driving()
    for n in range(1, 501):
        d = 0.011 if n % 100 == 0 else 0.004
        rig.feed(Measured(rig.t, rig.seq, d, "", 1.0, n, n // 100, 1, 3.0, 200.0))
    rig.feed(Measured(rig.t, rig.seq, 9.0, "jump", 1.0, 500, 5, 1, 3.0, 200.0))
    status = core.status(rig.state)["stream"]
    assert isinstance(status, dict)
    page = Page("t", "")
    story = tell(SimpleNamespace(message=message) for message in rig.log)
    _watched(page, story)
    ((gap, stood),) = story.watched.values()
    assert (gap.radius, stood.n, stood.exceedances, sum(stood.counts)) == (0.01, 500, 5, 500)
    html = page.html()
    for shown in (f"{anytime_upper(5, 500, 0.01):.3g}", f"{status['quantile']:.4g} (0.03)", "refuted", "3 of 100000"):
        assert shown in html, shown
    assert sum("of one law" in text for _, text, _ in story.marks) == 1
