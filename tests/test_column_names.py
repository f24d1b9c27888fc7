"""Columns by the field's usual names: one is read and said, two are refused, and a unit in a name is converted or refused."""

from __future__ import annotations

import json
import math

import pytest

from s2r_runtime.cli.main import main
from s2r_runtime.errors import RecordingError
from s2r_runtime.recordings.column_names import places, told
from s2r_runtime.recordings.tables import read_csv

UNICYCLE = ("t", "x", "y", "theta", "v", "w")


@pytest.mark.parametrize(
    ("header", "columns"),
    [
        ("time,pose_x,pose_y,yaw,cmd_v,cmd_w", None),
        ("timestamp,x,y,heading,linear_velocity,angular_velocity", None),
        ("stamp,pose.x,pose.y,pose.theta,cmd_vel.linear.x,cmd_vel.angular.z", None),
        ("Time,posX,posY,Yaw,linearVelocity,angularVelocity,battery", None),
        ("t,x,y,theta,v,w,yaw,velocity", "t,x,y,theta,v,w"),  # the model's own names come first
        ("t [s],x (m),y (m),theta_rad,v_mps,w (rad/s)", None),
    ],
)
def test_the_usual_names_are_found(header: str, columns: str | None) -> None:
    names = header.split(",")
    found = places(names, UNICYCLE, {}, "run.csv")
    assert [found[name].column for name in UNICYCLE] == (columns.split(",") if columns else names[:6])
    assert all(place.scale == 1.0 for place in found.values())


@pytest.mark.parametrize(
    ("column", "name", "scale"),
    [
        *(
            ("yaw_deg", "theta", math.pi / 180),
            ("heading [°]", "theta", math.pi / 180),
            ("time_ms", "t", 1e-3),
            ("timestamp_ns", "t", 1e-9),
        ),
        *(("x_mm", "x", 1e-3), ("speed_kmh", "v", 1 / 3.6), ("v [km/h]", "v", 1 / 3.6), ("yaw_rate_dps", "w", math.pi / 180)),
        *(("steering_angle_deg", "steer_cmd", math.pi / 180), ("wheel_left [rpm]", "wheel_left", math.pi / 30), ("pos_mm", "q", 1e-3)),
    ],
)
def test_a_unit_in_a_name_is_converted_and_said(column: str, name: str, scale: float) -> None:
    found = places([column, "other"], [name], {}, "run.csv")
    assert found[name].scale == pytest.approx(scale)
    assert f"{column!r} is read as {name} in " in told(found)
    stated = places([column, "other"], [name], {name: column}, "run.csv")
    assert stated[name].scale == pytest.approx(scale)  # whoever named the column
    assert f"{column!r} is read in " in told(stated)


@pytest.mark.parametrize(
    ("header", "words"),
    [
        ("t,x,y,yaw,heading,v,w", ("'yaw' and 'heading' may each be 'theta'", "--column theta=yaw")),
        ("time,timestamp,stamp,x,y,theta,v,w", ("'time', 'timestamp', 'stamp' may each be 't'",)),
        ("t,x,y,theta,cmd_v,linear_velocity,w", ("'cmd_v' and 'linear_velocity' may each be 'v'",)),
        ("t,x,y,theta,v,w [furlong]", ("'w [furlong]' seems to be 'w', in a unit that is not known for it",)),
        ("time [min],x,y,theta,v,w", ("'time [min]' seems to be 't'",)),
    ],
)
def test_what_is_ambiguous_or_in_an_unknown_unit_is_refused(header: str, words: tuple[str, ...]) -> None:
    with pytest.raises(RecordingError) as caught:
        places(header.split(","), UNICYCLE, {}, "run.csv")
    assert all(word in str(caught.value) for word in words), str(caught.value)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("column", ["yaw_m", "theta_s", "x_deg", "segment", "run", "battery", "x_ft"])
def test_another_quantity_is_no_guess(column: str) -> None:
    assert places([column], UNICYCLE, {}, "run.csv") == {}


def test_one_column_is_not_two_things() -> None:
    with pytest.raises(RecordingError, match="'velocity' may be 'speed' or 'v'; state which one it is: --column speed=velocity"):
        places(["velocity"], ["speed", "v"], {}, "run.csv")


@pytest.mark.parametrize("word", ["nan", "NaN", "-nan", "NA", "n/a", "null", "None", " nan "])
def test_words_for_no_value_are_blank_cells(tmp_path, word: str) -> None:
    for name, cell in (("blank.csv", ""), ("word.csv", word)):
        (tmp_path / name).write_text(f"t,x\n0,1\n0.1,{cell}\n0.2,3\n")
    blank, said = (read_csv(tmp_path / name, ("x",)) for name in ("blank.csv", "word.csv"))
    assert str(said.columns["x"].tolist()) == "[1.0, nan, 3.0]"
    assert said.content == blank.content


def test_degrees_and_milliseconds_give_the_same_gap_and_it_is_said(tmp_path, capsys) -> None:
    """The same drive in SI units by the model's names, and as a logger wrote it."""
    rows = [(0.1 * k, 0.02 * k + 1e-4 * math.sin(k), 0.0, 0.01 * math.cos(k), 0.2, 0.0) for k in range(60)]
    plain, logged = tmp_path / "plain.csv", tmp_path / "logged.csv"
    plain.write_text("t,x,y,theta,v,w\n" + "\n".join(",".join(map(repr, row)) for row in rows) + "\n")
    scale = (1e3, 1.0, 1.0, 180 / math.pi, 1.0, 1.0)
    logged.write_text(
        "time_ms,pose_x,pose_y,yaw_deg,cmd_v,cmd_w\n"
        + "\n".join(",".join(repr(a * b) for a, b in zip(row, scale, strict=True)) for row in rows)
        + "\n"
    )
    answers = []
    for path in (plain, logged):
        assert main(["gap", str(path), "--model", "unicycle", "--dt", "0.1", "--json"]) == 3  # a drive: no statement
        done = capsys.readouterr()
        answers.append(json.loads(done.out))
    assert answers[1]["radius"] == pytest.approx(answers[0]["radius"], rel=1e-9)
    assert "'time_ms' is read as t in ms, 'pose_x' is read as x" in done.err
    assert "'yaw_deg' is read as theta in deg" in done.err
    assert answers[1]["notes"] == [done.err.strip().removeprefix(f"s2r: {logged}: ")]
