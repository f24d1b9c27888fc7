"""Files as people have them, through `s2r trace`, on every model: what is wrong is said in a line, what is written otherwise is read."""

import json

import numpy as np
import pytest
from trace_robots import GEOMETRY, INPUTS, commands, drive

from s2r_runtime.cli.main import main

DT, ROWS = 0.05, 260
BOUNDS = {
    "unicycle": [(-0.3, 1.0), (-1.5, 1.5)],
    "bicycle": [(-0.4, 0.4), (0.2, 2.0)],
    "differential_drive": [(-3.0, 8.0)] * 2,
    "joint": [(-3.0, 3.0)],
    "double_integrator": [(-1.0, 1.0)] * 2,
}
STATES = {
    "unicycle": ("x", "y", "theta"),
    "bicycle": ("x", "y", "theta", "speed"),
    "differential_drive": ("x", "y", "theta", "wheel_left", "wheel_right"),
    "joint": ("q", "qd"),
    "double_integrator": ("x", "y", "vx", "vy"),
}
POSES = ("unicycle", "bicycle", "differential_drive")


@pytest.fixture(scope="module")
def recorded():
    """Model -> (t, y, u) of a robot whose first input acts by three quarters."""
    made = {}
    for name, bounds in BOUNDS.items():
        u = commands(np.random.default_rng(7), 1, ROWS, DT, bounds)
        y = drive(np.random.default_rng(8), name, u, [("input_gain", INPUTS[name][0], {"gain": 0.75})], DT, 1e-3)[0]
        made[name] = DT * np.arange(ROWS), y[:-1], u[0]
    return made


def _csv(name, t, y, u, header=None, comma=",", stamp="{:.6f}"):
    rows = [comma.join(header or ("t", *STATES[name], *INPUTS[name]))]
    rows += [comma.join([stamp.format(s), *("" if np.isnan(v) else f"{v:.6g}" for v in (*a, *b))]) for s, a, b in zip(t, y, u, strict=True)]
    return "\n".join(rows) + "\n"


def _trace(folder, capsys, name, text):
    """(exit code, the JSON that was printed, what else was said)."""
    path = folder / "run.csv"
    path.write_text(text, encoding="utf-8")
    parameters = [word for k, v in GEOMETRY.get(name, {}).items() for word in ("--param", f"{k}={v}")]
    code = main(["trace", str(path), "--model", name, "--dt", str(DT), *parameters, "--json"])
    out, err = capsys.readouterr()
    return code, json.loads(out) if out.strip() else {}, err.strip()


def _without(column):
    def spoil(name, t, y, u):
        y = y.copy()
        y[:, column] = y[0, column]
        return _csv(name, t, y, u)

    return spoil


def _swapped(name, t, y, u):
    return _csv(name, t, y[:, [1, 0, *range(2, y.shape[1])]], u)


REFUSED = {
    "ms": (lambda name, t, y, u: _csv(name, 1e3 * t, y, u), "t seems to be in ms, must be in s"),
    "ns since 1970": (
        lambda name, t, y, u: _csv(name, 1e9 * (1.76e9 + t), y, u, stamp="{:.0f}"),
        "if it is in ns, name it t_ns in the header",
    ),
    "dates": (lambda name, t, y, u: _csv(name, t, y, u, stamp="2026-11-21T10:00:{:09.6f}"), "line 2: column 't' is '2026-11-21T10:00:0"),
    "units": (
        lambda name, t, y, u: _csv(name, t, y, u, [f"{s} [SI]" for s in ("t", *STATES[name], *INPUTS[name])]),
        "in a unit that is not known for it",
    ),
    "semicolons": (lambda name, t, y, u: _csv(name, t, y, u, comma=";").replace(".", ","), "are its columns separated by commas?"),
    "tabs": (lambda name, t, y, u: _csv(name, t, y, u, comma="\t"), "are its columns separated by commas?"),
    "nan": (lambda name, t, y, u: _csv(name, t, np.where(t[:, None] == t[9], np.inf, y), u), "line 11: column "),
    "unsorted": (
        lambda name, t, y, u: _csv(name, np.where(t == t[50], t[40], t), y, u),
        "line 52: time runs backwards, from 2.45 s to 2.0 s",
    ),
    "first state": (_without(0), "in every row although the model moves it: it was not measured"),
    "last state": (_without(-1), "in every row although the model moves it: it was not measured"),
    "exchanged": (_swapped, "seem to be exchanged"),
    "twenty rows": (lambda name, t, y, u: _csv(name, t[:20], y[:20], u[:20]), "at least 60 are needed: 41 more"),
    "one row": (
        lambda name, t, y, u: _csv(name, t[:1], y[:1], u[:1]),
        "at one moment only, on 1 row; how it changes is told by rows that are a step",
    ),
    "one moment": (
        lambda name, t, y, u: _csv(name, 0.0 * t + 0.5, y, u),
        "at one moment only, on 260 rows; how it changes is told by rows that are a step",
    ),
    "nothing was done": (lambda name, t, y, u: _csv(name, t, 0.0 * y, 0.0 * u), "every input is zero"),
    "nothing but noise": (
        lambda name, t, y, u: _csv(name, t, np.random.default_rng(3).normal(0.0, 0.3, y.shape), u),
        "; nothing can be traced",
    ),
    "one row again and again": (lambda name, t, y, u: _csv(name, t, 0.0 * y + y[90], 0.0 * u + u[90] + 0.1), "asked to move"),
}
TOO_LITTLE = {"twenty rows", "one row", "one moment", "nothing was done", "nothing but noise", "one row again and again"}


@pytest.mark.slow
@pytest.mark.parametrize("name", BOUNDS)
@pytest.mark.parametrize("case", REFUSED)
def test_what_is_wrong_is_said_in_one_line(tmp_path, capsys, recorded, case, name):
    spoil, said = REFUSED[case]
    code, answer, err = _trace(tmp_path, capsys, name, spoil(name, *recorded[name]))
    assert code == (3 if case in TOO_LITTLE else 2)
    assert answer.get("verdict") is None
    assert said in err
    assert "\n" not in err
    assert len(err) < 400 + len(str(tmp_path))


@pytest.mark.slow
@pytest.mark.parametrize("turn", [180.0, 360.0])
@pytest.mark.parametrize("name", POSES)
def test_degrees_are_told_wrapped_or_not(tmp_path, capsys, recorded, name, turn):
    t, y, u = recorded[name]
    degrees = (np.degrees(y[:, 2]) - turn) % 360.0 + turn - 360.0
    code, _, err = _trace(tmp_path, capsys, name, _csv(name, t, np.column_stack([y[:, :2], degrees, y[:, 3:]]), u))
    assert code == 2
    assert "theta seems to be in degrees, must be in rad" in err


WRITTEN = {
    "doubled rows": lambda name, t, y, u: _csv(name, *(np.repeat(a, 2, axis=0) for a in (t, y, u))),
    "a recorder twice as fast": lambda name, t, y, u: _csv(
        name, 0.5 * DT * np.arange(2 * len(t)), *(np.repeat(a, 2, axis=0) for a in (y, u))
    ),
    "holes": lambda name, t, y, u: _csv(name, t, np.where(np.random.default_rng(1).random(y.shape) < 0.04, np.nan, y), u),
    "since 1970": lambda name, t, y, u: _csv(name, 1.76e9 + t, y, u),
    "from a spreadsheet": lambda name, t, y, u: "\ufeff" + _csv(name, t, y, u).replace("\n", "\r\n").replace(",", ", ", len(STATES[name])),
}


@pytest.mark.slow
@pytest.mark.parametrize("case", WRITTEN)
def test_what_is_only_written_otherwise_is_read(tmp_path, capsys, recorded, case):
    code, answer, _ = _trace(tmp_path, capsys, "joint", WRITTEN[case]("joint", *recorded["joint"]))
    assert code == 0
    assert [(e["name"], e["channel"]) for e in answer["effects"]] == [("input_gain", "force")]
    assert answer["effects"][0]["parameters"]["gain"]["value"] == pytest.approx(0.75, abs=0.02)


@pytest.mark.slow
def test_a_column_under_another_writing_is_not_taken_for_one_that_was_not_measured(tmp_path, capsys, recorded):
    code, _, err = _trace(tmp_path, capsys, "joint", _csv("joint", *recorded["joint"], header=("t", "q", "QD", "force")))
    assert code == 0
    assert "'QD' is read as qd" in err


@pytest.mark.slow
def test_a_recording_to_judge_on_must_be_long_enough_to_judge(tmp_path, capsys, recorded):
    t, y, u = recorded["unicycle"]
    other = y[:12] + np.random.default_rng(4).normal(0.0, 1e-3, (12, 3))  # another drive: its rows were not seen
    (tmp_path / "run.csv").write_text(_csv("unicycle", t, y, u), encoding="utf-8")
    (tmp_path / "test.csv").write_text(_csv("unicycle", t[:12], other, u[:12]), encoding="utf-8")
    code = main(["trace", str(tmp_path / "run.csv"), "--model", "unicycle", "--dt", str(DT), "--test", str(tmp_path / "test.csv")])
    said = capsys.readouterr().err.strip()
    assert code == 3
    assert "test.csv: 11 usable transitions of 0.05 s, at least 24 are needed: 13 more" in said


@pytest.mark.slow
def test_runs_of_two_rows_are_traced_whatever_goes_on_in_between(tmp_path, capsys, recorded):
    """As a campaign's table has them: no rollout is longer than its one step."""
    t, y, u = recorded["unicycle"]
    rows = ["segment,t,x,y,theta,v,w"]
    for k in range(0, ROWS - 1, 2):
        rows += [f"{k},{t[j]:.6f}," + ",".join(f"{v:.6g}" for v in (*y[j], *u[j])) for j in (k, k + 1)]
    path = tmp_path / "pairs.csv"
    path.write_text("\n".join(rows) + "\n")
    assert main(["trace", str(path), "--model", "unicycle", "--dt", str(DT), "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["verdict"] != "sensor_fault"


@pytest.mark.slow
def test_no_state_is_another_thing_than_one_moment(tmp_path, capsys, recorded):
    t, y, u = recorded["unicycle"]
    code, _, err = _trace(tmp_path, capsys, "unicycle", _csv("unicycle", t, np.nan * y, u))
    assert (code, "has no row on which a state was measured" in err) == (2, True)
    t, y, u = recorded["joint"]
    code, _, err = _trace(tmp_path, capsys, "joint", _csv("joint", t[:1], y[:1, :1], u[:1], ["t", "q", "force"]))
    assert (code, "qd cannot be told: fewer than " in err) == (3, True)


@pytest.mark.slow
def test_rollouts_shorter_than_asked_are_said(tmp_path, capsys, recorded):
    t, y, u = recorded["unicycle"]
    (tmp_path / "run.csv").write_text(_csv("unicycle", t, y, u))
    lengths = []
    for asked in ("1", "60"):
        assert main(["trace", str(tmp_path / "run.csv"), "--model", "unicycle", "--dt", str(DT), "--horizon", asked, "--json"]) == 0
        out, err = capsys.readouterr()
        lengths.append(json.loads(out)["error"]["before"]["rollout_horizon_s"])
        said = f"--horizon 60: what was judged on bears no such rollouts; they are {lengths[-1]:.4g} s long"
        assert (said in err) == (asked == "60")
    assert lengths[0] == pytest.approx(1.0)
    assert lengths[0] < lengths[1] < 0.5 * ROWS * DT
