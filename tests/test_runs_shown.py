"""What an operator reads of the runs that a controller drove: status, report, sentences. And how the counts reach the disk (G10)."""

from __future__ import annotations

import errno
import threading
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import msgspec
import pytest
from report_rig import Answered

from s2r_runtime.cli.daemon_verbs import _runs
from s2r_runtime.core import reducer as core
from s2r_runtime.core import runs
from s2r_runtime.daemon.past import forgotten, lost
from s2r_runtime.daemon.persistence import StateFolder
from s2r_runtime.daemon.saver import Saver
from s2r_runtime.evidence.statements import of_runs, runs_line
from s2r_runtime.messages import MEMORY_SCHEMA, EpisodeCounted, EpisodeEnded, Memory, OpenRun, RunCounts, RunLimits
from s2r_runtime.report.page import Page
from s2r_runtime.report.runs_section import add_runs
from s2r_runtime.report.story import tell


def limits(n: int, unsafe: int = 0, censored: int = 0) -> RunLimits:
    counts = RunCounts("k", "", 1, runs.share(0.1, 1), n, unsafe, censored)
    (found,) = runs._limits(counts)
    return found


def test_the_operator_s_line_is_rounded_against_the_controller() -> None:
    found = limits(412)
    assert runs_line(found) == (
        "of the runs this controller drives on this robot, at most 0.86 % are unsafe (95 %, as of now, 412 runs, none unsafe)"
    )
    assert 0.0085 < found.upper < 0.0086
    assert "(95 %, as of now, 300 runs, 3 unsafe, 2 with an unknown end)" in runs_line(limits(300, 3, 2))
    assert "at most 98 % are unsafe (95 %, as of now, 1 run, none unsafe)" in runs_line(limits(1))
    assert "at most 100 % are unsafe" in runs_line(limits(2, 2))


def test_the_statement_has_both_limits_with_their_confidences() -> None:
    said = of_runs(limits(300, 3, 1))
    assert "Of 300 runs that this controller drove on this robot, 3 were unsafe." in said
    assert "1 had an unknown end" in said
    assert ", 1 was unsafe. With" in of_runs(limits(300, 1))
    assert ", none were unsafe. With" in of_runs(limits(300))
    assert "With confidence 95.4405 % their mean probability of being unsafe is at most" in said
    assert "With confidence 98.4801 % it is at least" in said


def driven(*safety: float, **changes: Any) -> Answered:
    rig = Answered(beta_episodes=0.1, **changes)
    rig.driving()
    for index, value in enumerate((0.5, *safety)):  # the first began while the gate settled
        rig.observe()
        rig.feed(EpisodeEnded(rig.t, index, 20, value, 1.0))
        if rig.state.deployment is not None:
            rig.propose()
    return rig


def test_the_report_shows_the_limits_over_runs_and_each_run_that_was_not_safe() -> None:
    rig = driven(0.5, -0.25, 0.5, 0.5, max_unsafe=0.9)
    story = tell(SimpleNamespace(message=message) for message in rig.log)
    page = Page("t", "")
    add_runs(page, story.runs, story.settings)
    html = page.html()
    last = [message for message in rig.log if isinstance(message, EpisodeCounted)][-1].limits[0]
    for shown in (
        "Runs on this robot",
        runs_line(last),
        "-0.250",
        "its safety value is below the threshold",
        "Left out: 1 runs",
        "<svg",
    ):
        assert shown in html, shown


def test_the_status_says_it_in_a_line_and_that_a_controller_is_refused() -> None:
    rig = driven(0.5, 0.5)
    shown = _with_statement(core.status(rig.state)["runs"])
    assert _runs(shown) == [shown["all"]["statement"]]
    rig = driven(*[-0.5] * 9, max_unsafe=0.01)
    shown = _with_statement(core.status(rig.state)["runs"])
    line, least, refused = _runs(shown)
    assert least == f"at least {100.0 * shown['all']['lower']:.2g} % are unsafe; 1 % are allowed"
    assert refused.startswith("REFUSED")
    assert line == shown["all"]["statement"]
    assert _runs(None) == _runs({"all": None}) == []


def _with_statement(shown: Any) -> Any:
    for name in ("all", "under_certificate"):
        if shown[name] is not None:
            shown[name]["statement"] = runs_line(msgspec.convert(shown[name], RunLimits))
    return shown


# ---------------------------------------------------------------- what is persisted


def memory(n: int = 0, **changes: Any) -> Memory:
    counts = (RunCounts("k", "", 1, 0.06, n), RunCounts("k", "c", 1, 0.06, n)) if n else ()
    return msgspec.structs.replace(Memory("r", MEMORY_SCHEMA, runs=counts, run_sequences=len(counts) // 2), **changes)


def test_a_state_that_forgets_runs_forgets() -> None:
    full = memory(5, drives=3, open_run=OpenRun("k", "c"))
    for older, what in (
        (memory(4, drives=3), "runs of controller k: 5 were counted"),
        (memory(0, drives=3), "sequences of runs: 1 were begun"),
        (memory(5, drives=2), "drives: 3 starts and ends"),
        (msgspec.structs.replace(full, runs=()), "the 5 runs of controller k"),
    ):
        assert what in forgotten(full, older)
        assert what in lost(full, older)
    assert forgotten(full, full) == ""
    assert lost(full, memory(6, drives=4)) == ""
    assert forgotten(memory(5, drives=3), memory(5, drives=4)) == "", "a run that was left out"
    exceeded = msgspec.structs.replace(full, runs=tuple(msgspec.structs.replace(one, exceeded=True) for one in full.runs))
    assert "runs of controller k" in lost(exceeded, full)
    assert lost(exceeded, memory(0, drives=4, run_sequences=1, runs_cleared=1)) == "", "a person cleared it"


def test_the_newest_memory_is_saved_from_a_thread_and_never_an_older_one_after_it(tmp_path: Path) -> None:
    with StateFolder(tmp_path / "r", "r") as folder:
        saver = Saver(folder)
        for n in range(1, 20):
            saver.soon(memory(n))
            if n % 3 == 0:
                saver.now(memory(n, drives=n))
                assert folder.memory().runs[0].n == n
        saver.close()
        assert folder.memory() == memory(19)
        saver.close()


def test_a_thread_that_cannot_save_says_why_until_a_save_succeeds(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with StateFolder(tmp_path / "r", "r") as folder:
        tried, save = threading.Event(), folder.save

        def full(_: Memory) -> None:
            tried.set()
            raise OSError(errno.ENOSPC, "No space left on device")

        monkeypatch.setattr(folder, "save", full)
        saver = Saver(folder)
        saver.soon(memory(1))
        assert tried.wait(10.0)
        saver.close()
        assert saver.trouble == "No space left on device"
        monkeypatch.setattr(folder, "save", save)
        saver.now(memory(2))
        assert saver.trouble == ""
