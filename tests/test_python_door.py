"""`import s2r_runtime as s2r`: models and recordings of every form give what the command line gives, and bad input one clear line."""

from __future__ import annotations

import inspect
import json
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import s2r_runtime as s2r
from s2r_runtime.api import progress as api_progress
from s2r_runtime.api.spelling import in_python
from s2r_runtime.cli.main import main, parser
from s2r_runtime.recordings.tables import read_csv

MOTOR = Path(__file__).parent.parent / "examples" / "motor"
DRIVE, ANOTHER, FILE = (MOTOR / name for name in ("drive.csv", "another.csv", "motor.py"))
TABLE = read_csv(DRIVE)
ARRAYS = {"t": TABLE.t, **TABLE.columns}
SHORT = {name: values[:200] for name, values in ARRAYS.items()}

FORMS: dict[str, Callable[[dict[str, Any]], Any]] = {
    "dict": dict,
    "lists": lambda columns: {name: values.tolist() for name, values in columns.items()},
    "pandas": lambda columns: pytest.importorskip("pandas").DataFrame(columns),
    "pandas with t as the index": lambda columns: pytest.importorskip("pandas").DataFrame(columns).set_index("t"),
    "polars": lambda columns: pytest.importorskip("polars").DataFrame(columns),
}


def printed(capsys: pytest.CaptureFixture[str], *verb: str) -> str:
    """What the command line prints."""
    assert main(verb) in {0, 3}
    return capsys.readouterr().out.strip()


def motor(x: Any, u: Any, dt: float, params: dict[str, float]) -> Any:
    settled = u / params["k"]
    return settled + (x - settled) * np.exp(-(params["k"] ** 2) / 2.0 / 4e-4 * dt)


def function_model() -> s2r.Model:
    return s2r.model(motor, dt=0.02, states=("speed",), inputs=("volts",), param={"k": 0.05})


# ---------------------------------------------------------------- the import


def test_the_import_is_quick_and_loads_no_library() -> None:
    code = (
        "import sys, time; begin = time.process_time(); import s2r_runtime; took = time.process_time() - begin;"
        "print(took, sorted({'numpy', 'scipy', 'msgspec', 'pandas', 'matplotlib', 'argparse'} & {*sys.modules}))"
    )
    took, _, loaded = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout.partition(" ")
    assert (float(took) < 0.15, loaded.strip()) == (True, "[]")


def test_functions_stay_where_they_are_whatever_submodule_is_imported() -> None:
    code = (
        "import s2r_runtime.gap, s2r_runtime.verify, s2r_runtime.trace.pipeline, s2r_runtime.audit.log, s2r_runtime.recording;"
        "import s2r_runtime as s2r; from s2r_runtime.trace import VERSION; from s2r_runtime.evidence.gap import estimate_gap;"
        "print(*(callable(getattr(s2r, name)) for name in s2r.__all__))"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert set(done.stdout.split()) == {"True"}


def test_every_public_function_is_documented_and_typed() -> None:
    for name in s2r.__all__:
        public = getattr(s2r, name)
        assert public.__doc__, name
        if inspect.isfunction(public):
            parameters = inspect.signature(public).parameters.values()
            assert all(one.annotation is not inspect.Parameter.empty for one in parameters), name
            assert "Raises" in public.__doc__, name


def test_an_unknown_name_is_an_ordinary_error() -> None:
    with pytest.raises(AttributeError, match="no_such_name"):
        s2r.no_such_name  # noqa: B018


@pytest.mark.parametrize(
    ("function", "verb"), [("gap", "gap"), ("trace", "trace"), ("verify", "verify"), ("certify", "certify"), ("audit", "audit")]
)
def test_keywords_are_the_options_of_the_command_line(function: str, verb: str) -> None:
    verbs = next(action for action in parser()._actions if action.dest == "verb").choices
    assert isinstance(verbs, dict)
    options = {action.dest for action in verbs[verb]._actions}
    keywords = {name for name in inspect.signature(getattr(s2r, function)).parameters if name != "progress"}
    assert keywords <= options


# ---------------------------------------------------------------- the same numbers


@pytest.mark.parametrize("form", FORMS)
def test_a_gap_in_memory_is_bit_for_bit_that_of_the_same_csv(form: str, capsys: pytest.CaptureFixture[str]) -> None:
    expected = json.loads(printed(capsys, "gap", str(DRIVE), "--model", str(FILE), "--dt", "0.02", "--json"))
    found = s2r.gap(FORMS[form](ARRAYS), FILE, dt=0.02).to_dict()
    differ = {name for name in expected if json.loads(json.dumps(found[name])) != expected[name]}
    # how it is called, and the digest of the file's bytes; the sentence has the same numbers
    assert differ == {"recording", "transitions_digest"}


@pytest.fixture(scope="module")
def steps() -> list[s2r.Step]:
    """Progress of the trace below."""
    return []


@pytest.fixture(scope="module")
def traced(steps: list[s2r.Step]) -> s2r.Trace:
    return s2r.trace(ARRAYS, FILE, dt=0.02, progress=steps.append)


def test_a_trace_in_memory_is_bit_for_bit_that_of_the_same_csv(
    traced: s2r.Trace, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    repaired = tmp_path / "repaired.toml"
    expected = printed(capsys, "trace", str(DRIVE), "--model", str(FILE), "--dt", "0.02", "--json", "-o", str(repaired))
    assert json.dumps(traced.to_dict()) == expected
    assert (traced.verdict, [effect["name"] for effect in traced.effects]) == ("traced", ["input_delay", "coulomb_friction"])
    saved = s2r.model(traced.model.save(tmp_path / "mine.toml"))
    assert saved.effects == s2r.model(repaired).effects == traced.model.effects


@pytest.mark.slow
@pytest.mark.parametrize("form", FORMS)
def test_so_is_that_of_every_other_form(form: str, traced: s2r.Trace) -> None:
    assert s2r.trace(FORMS[form](ARRAYS), FILE, dt=0.02).to_dict() == traced.to_dict()


@pytest.mark.slow
@pytest.mark.parametrize("library", ["pandas", "polars"])
def test_so_is_that_of_a_file_that_another_library_read(library: str, traced: s2r.Trace) -> None:
    assert s2r.trace(pytest.importorskip(library).read_csv(DRIVE), FILE, dt=0.02).to_dict() == traced.to_dict()


def test_the_summary_is_what_the_command_line_prints(traced: s2r.Trace, capsys: pytest.CaptureFixture[str]) -> None:
    options = ("--model", str(FILE), "--dt", "0.02")
    assert s2r.gap(DRIVE, FILE, dt=0.02).summary() == printed(capsys, "gap", str(DRIVE), *options)
    assert traced.summary().strip() == printed(capsys, "trace", str(DRIVE), *options)


def test_what_a_fit_saw_in_memory_is_refused_for_its_gap_from_the_file(traced: s2r.Trace) -> None:
    repaired = traced.model
    for seen in (DRIVE, {name: values[300:900] for name, values in ARRAYS.items()}):
        with pytest.raises(s2r.NotEnoughEvidence, match="the model was fitted on"):
            s2r.gap(seen, repaired, blocking=0.5)


def test_dates_numbers_in_text_and_missing_values_are_read() -> None:
    pandas = pytest.importorskip("pandas")
    frame = pandas.DataFrame(SHORT)
    odd = frame.assign(note="text", flag=True, volts=frame.volts.map(repr)).astype({"speed": "Float64"})
    odd.index = pandas.to_datetime(1_700_000_000_000 + (frame.t * 1000).round().astype("int64"), unit="ms", utc=True)
    odd.loc[odd.index[5], "speed"] = pandas.NA
    table = s2r.recording(odd.drop(columns="t")).sources[0]
    columns = read_csv(table, ["speed", "volts"])
    np.testing.assert_allclose(columns.t, SHORT["t"], atol=1e-9)
    assert np.isnan(columns.columns["speed"]).nonzero()[0].tolist() == [5]
    np.testing.assert_array_equal(columns.columns["volts"], SHORT["volts"])


def test_segments_and_several_recordings_are_runs_of_their_own() -> None:
    half = {name: values[100:] for name, values in SHORT.items()}
    first = {name: values[:100] for name, values in SHORT.items()}
    several = s2r.gap([first, half], FILE, dt=0.02)
    together = s2r.gap({**SHORT, "segment": [0] * 100 + [1] * 100}, FILE, dt=0.02, epsilon=0.7, beta=0.4)
    assert (several.n, together.n, together.independent) == (198, 2, True)


def test_a_recording_keeps_its_options_and_shows_what_it_holds() -> None:
    renamed = {"zeit": SHORT["t"], "omega": SHORT["speed"], "u": SHORT["volts"]}
    given = s2r.recording(renamed, column={"t": "zeit", "speed": "omega", "volts": "u"}, name="drive 3")
    assert s2r.gap(given, FILE, dt=0.02).radius == s2r.gap(SHORT, FILE, dt=0.02).radius
    assert str(s2r.recording(SHORT)).startswith("the dict of arrays: table; 1 topic")
    assert given.columns().keys() == {"t", "omega", "u", "zeit"}


# ---------------------------------------------------------------- models


def test_a_function_is_a_model() -> None:
    mine, sheet = function_model(), s2r.model(FILE, dt=0.02)
    np.testing.assert_allclose(mine.step([[1.0], [2.0]], [[3.0], [4.0]]), sheet.step([[1.0], [2.0]], [[3.0], [4.0]]))
    assert mine.rollout([0.0], np.ones((5, 1))).shape == (6, 1)
    found = s2r.trace(ARRAYS, mine)
    assert {effect["name"] for effect in found.effects} == {"input_delay", "coulomb_friction"}
    assert found.model.rollout([0.0], np.ones((5, 1)))[3, 0] == 0.0  # the delay of three steps
    with pytest.raises(s2r.UsageError, match="lives in this process only"):
        found.model.to_toml()


def test_a_model_is_a_value_with_an_account() -> None:
    joint = s2r.model("joint", dt=0.1, param={"mass": 2.0})
    assert (joint.states, joint.inputs, joint.dt, joint.parameters) == (("q", "qd"), ("force",), 0.1, {"mass": 2.0})
    assert joint.summary().startswith("model joint, step 0.1 s")
    assert "<strong>model joint" in joint._repr_html_()
    with pytest.raises(AttributeError):
        joint.comments = ()  # type: ignore[misc]


# ---------------------------------------------------------------- results


def test_results_draw_themselves_and_return_axes(traced: s2r.Trace) -> None:
    pyplot = pytest.importorskip("matplotlib.pyplot")
    pyplot.switch_backend("agg")
    assert [len(axes.lines) for axes in traced.plot()] == [3]
    assert s2r.gap(ANOTHER, FILE, dt=0.02).plot().patches
    _, mine = pyplot.subplots()
    assert s2r.recording(SHORT).plot(mine) == [mine]
    pyplot.close("all")


def test_html_of_a_result_holds_no_markup_of_the_recording() -> None:
    found = s2r.gap(s2r.recording(SHORT, name="<script>alert(1)</script>"), FILE, dt=0.02)
    evil = s2r.recording({"t": SHORT["t"], "<b>x</b>": SHORT["speed"]})
    assert "<script>" not in found._repr_html_()
    assert "<b>" not in evil._repr_html_()


def test_a_trace_in_a_notebook_is_a_table_of_effects(traced: s2r.Trace) -> None:
    shown = traced._repr_html_()
    assert "<th>95 % interval</th>" in shown
    assert "<td>coulomb_friction</td><td>speed</td><td>force</td>" in shown


def test_long_work_shows_a_bar_of_tqdm(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    pytest.importorskip("tqdm")
    monkeypatch.setattr(api_progress, "QUIET_S", 0.0)
    s2r.gap(DRIVE, FILE, dt=0.02, progress=True)
    assert "reading 100%" in capsys.readouterr().err
    s2r.gap(DRIVE, FILE, dt=0.02)  # nobody looks
    assert capsys.readouterr().err == ""


def test_progress_comes_by_phase_with_the_time_left(traced: s2r.Trace, steps: list[s2r.Step]) -> None:
    assert {one.phase for one in steps} >= {"tracing"}
    assert steps[-1].done == steps[-1].total == 100.0
    assert any(one.seconds_left is not None and one.seconds_left >= 0.0 for one in steps)


# ---------------------------------------------------------------- bad input


BAD: dict[str, tuple[Callable[[], Any], type[Exception], str]] = {
    "an empty frame": (lambda: s2r.gap({"t": [], "speed": [], "volts": []}, FILE, dt=0.02), s2r.RecordingError, "has columns and no rows"),
    "no column": (lambda: s2r.gap({}, FILE, dt=0.02), s2r.RecordingError, "is empty, must have named columns"),
    "a column that lacks": (
        lambda: s2r.trace({"t": SHORT["t"], "speed": SHORT["speed"], "vlts": SHORT["volts"]}, FILE, dt=0.02),
        s2r.RecordingError,
        r"the dict of arrays: lacks the column 'volts' \(nearest: 'vlts'\); it has: t, speed, vlts; others: column=\{'NAME': 'COLUMN'\}",
    ),
    "a renamed column that lacks": (
        lambda: s2r.gap(SHORT, FILE, dt=0.02, column={"speed": "omega"}),
        s2r.RecordingError,
        "lacks the column 'omega'",
    ),
    "an unknown state": (
        lambda: s2r.gap(SHORT, FILE, dt=0.02, column={"sped": "speed"}),
        s2r.UsageError,
        r"column=\{'sped': 'speed'\}: the model has no state or input 'sped'; it has: speed, volts",
    ),
    "nothing measured": (
        lambda: s2r.trace({**SHORT, "speed": np.full(200, np.nan)}, FILE, dt=0.02),
        s2r.RecordingError,
        "has no row on which a state was measured",
    ),
    "a stamp that lacks": (
        lambda: s2r.gap({**SHORT, "t": np.where(SHORT["t"] == SHORT["t"][3], np.nan, SHORT["t"])}, FILE, dt=0.02),
        s2r.RecordingError,
        "row 3: column 't' is blank",
    ),
    "an infinity": (
        lambda: s2r.gap({**SHORT, "speed": np.full(200, np.inf)}, FILE, dt=0.02),
        s2r.RecordingError,
        "row 0: column 'speed' is 'inf', must be a finite number",
    ),
    "text": (
        lambda: s2r.gap({**SHORT, "speed": ["fast"] * 200}, FILE, dt=0.02),
        s2r.RecordingError,
        "row 0: column 'speed' is 'fast', must be a number",
    ),
    "time that runs backwards": (
        lambda: s2r.gap({**SHORT, "t": SHORT["t"][::-1]}, FILE, dt=0.02),
        s2r.RecordingError,
        "row 1: time runs backwards",
    ),
    "columns of unequal lengths": (
        lambda: s2r.gap({**SHORT, "volts": [1.0, 2.0]}, FILE, dt=0.02),
        s2r.RecordingError,
        "column 'volts' has 2 rows, 't' has 200; must be of one length",
    ),
    "a matrix as a column": (
        lambda: s2r.gap({**SHORT, "volts": np.ones((200, 2))}, FILE, dt=0.02),
        s2r.RecordingError,
        r"column 'volts' has the shape \(200, 2\), must be \(n,\)",
    ),
    "columns without names": (lambda: s2r.gap({0: SHORT["t"]}, FILE, dt=0.02), s2r.RecordingError, "columns must be named by text"),
    "one recording twice": (
        lambda: s2r.trace([SHORT, SHORT], FILE, dt=0.02),
        s2r.UsageError,
        "is the recording the dict of arrays 1 once more",
    ),
    "a test that the fit sees": (lambda: s2r.trace(SHORT, FILE, dt=0.02, test=SHORT), s2r.UsageError, "take one that the fit never sees"),
    "too little": (lambda: s2r.trace({k: v[:20] for k, v in SHORT.items()}, FILE, dt=0.02), s2r.NotEnoughEvidence, "transitions"),
    "no recording": (lambda: s2r.gap([], FILE, dt=0.02), s2r.RecordingError, "the list is empty"),
    "no file": (lambda: s2r.gap("nowhere.csv", FILE, dt=0.02), s2r.RecordingError, "nowhere.csv: cannot be read: No such file"),
    "a number as a recording": (lambda: s2r.gap(3, FILE, dt=0.02), TypeError, "must be a path, a pandas or polars DataFrame"),
    "an unknown option": (lambda: s2r.gap(SHORT, FILE, dt=0.02, espilon=0.1), TypeError, "espilon"),  # type: ignore[call-arg]
    "a column option of text": (lambda: s2r.gap(SHORT, FILE, dt=0.02, column="v"), TypeError, "must be a dict"),  # type: ignore[arg-type]
    "no model": (lambda: s2r.gap(SHORT), s2r.UsageError, "which model. give profile=P, or model=M dt=DT"),
    "no step": (lambda: s2r.gap(SHORT, FILE), s2r.UsageError, "needs its step: dt=DT"),
    "a step of nothing": (lambda: s2r.model("joint", dt=0.0), s2r.UsageError, "dt: dt is 0.0 s, must be > 0"),
    "an unknown model": (lambda: s2r.model("jiont", dt=0.1), s2r.ConfigError, "unknown model 'jiont'"),
    "an unknown parameter": (lambda: s2r.model("joint", dt=0.1, param={"m": 1.0}), s2r.UsageError, "param m: model 'joint' has no such"),
    "a parameter that is no number": (lambda: s2r.model("joint", dt=0.1, param={"mass": float("nan")}), s2r.UsageError, "param: "),
    "a number as a model": (lambda: s2r.gap(SHORT, 3, dt=0.1), TypeError, "model: is int"),  # type: ignore[arg-type]
    "a function without names": (lambda: s2r.model(motor, dt=0.1), s2r.UsageError, r"states=\(...\), inputs=\(...\)"),
    "a function of one state": (
        lambda: s2r.model(lambda x, u, dt, p: [x[0] + dt * u[0]], dt=0.1, states=("x",), inputs=("u",)),
        s2r.ConfigError,
        "step",
    ),
    "names of a model with a name": (lambda: s2r.model("joint", dt=0.1, states=("q",)), s2r.UsageError, "belong to a function"),
    "a probability": (lambda: s2r.gap(SHORT, FILE, dt=0.02, epsilon=0.0), s2r.UsageError, "epsilon is 0.0, must be between 0 and 1"),
    "a weight": (
        lambda: s2r.gap(SHORT, FILE, dt=0.02, weight={"v": 1.0}),
        s2r.UsageError,
        r"weight=\{'v': 1\}: the model has no state 'v'",
    ),
    "a set": (lambda: s2r.gap(SHORT, FILE, dt=0.02, set="cube"), s2r.UsageError, "must be ball or box"),  # type: ignore[arg-type]
    "a horizon": (lambda: s2r.trace(SHORT, FILE, dt=0.02, horizon=0.001), s2r.UsageError, "horizon 0.001: must be at least"),
    "no profile": (lambda: s2r.verify("c.py", profile="no.toml", radius=0.1), s2r.ConfigError, "no.toml"),
    "radius and recording": (lambda: s2r.verify("c.py", profile="no.toml"), s2r.UsageError, "either radius=R or recording=REC"),
    "text as a number": (lambda: s2r.gap(SHORT, FILE, dt=0.02, epsilon="1"), TypeError, "epsilon: is '1', must be a number"),  # type: ignore[arg-type]
    "a list of parameters": (lambda: s2r.model("joint", dt=0.1, param=["mass"]), TypeError, "param: is"),  # type: ignore[arg-type]
    "a seed below 0": (lambda: s2r.trace(SHORT, FILE, dt=0.02, seed=-1), s2r.UsageError, "seed: is -1, must be >= 0"),
    "a seed with a fraction": (lambda: s2r.trace(SHORT, FILE, dt=0.02, seed=1.5), TypeError, "seed: is 1.5, must be a whole"),  # type: ignore[arg-type]
    "a bandwidth of nothing": (lambda: s2r.trace(SHORT, FILE, dt=0.02, bandwidth=0.0), s2r.UsageError, "bandwidth: is 0, must be > 0"),
    "states of one sample": (lambda: function_model().step([0.0], [1.0]), s2r.UsageError, r"must be \(n, 1\): speed"),
    "states that are text": (lambda: function_model().step([["a"]], [[1.0]]), s2r.UsageError, "must be a table of numbers"),
    "too many states": (lambda: function_model().rollout([0.0, 1.0], [[1.0]]), s2r.UsageError, r"x0 has the shape \(2,\), must be \(1,\)"),
    "a number as a log": (lambda: s2r.read_log(3), TypeError, "log: is int, must be a path"),  # type: ignore[arg-type]
    "no log": (lambda: s2r.audit("no.mcap"), s2r.UsageError, "no.mcap: no such log file"),
    "a head": (lambda: s2r.audit(DRIVE, head="abc"), s2r.UsageError, "64 hexadecimal digits"),
    "a table as a log": (lambda: s2r.read_log(DRIVE), s2r.RecordingError, "drive.csv"),
    "no daemon": (lambda: s2r.connect(socket="no.sock"), s2r.UsageError, "no daemon listens there"),
}


@pytest.mark.parametrize("what", BAD)
def test_bad_input_is_one_clear_line(what: str) -> None:
    call, kind, message = BAD[what]
    with pytest.raises(kind, match=message) as caught:
        call()
    assert "\n" not in str(caught.value)
    assert "--" not in str(caught.value)


def test_messages_name_options_as_keywords() -> None:
    assert in_python("to read more: --max-gb GB") == "to read more: max_gb=GB"
    assert in_python("state which: --column v=speed, or --hold-radius") == "state which: column={'v': 'speed'}, or hold_radius"
    assert in_python("-n 10: too few; a-o stays, and pre--fix") == "n 10: too few; a-o stays, and pre--fix"
