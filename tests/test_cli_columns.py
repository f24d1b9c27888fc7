"""`--column NAME=COLUMN`: a table whose columns have other names than the model's."""

import json
import re
from pathlib import Path

import pytest

from s2r_runtime.cli.main import main

ROBOTARIUM = Path(__file__).parent.parent / "profiles" / "robotarium.toml"
MODEL = ("--model", "unicycle", "--dt", "0.1")
NAMES = {"x": "pose.x", "y": "pose.y", "theta": "yaw", "v": "cmd_vel.linear.x", "w": "cmd_vel.angular.z"}
COLUMNS = [f"--column={name}={column}" for name, column in NAMES.items()]


RUNS = 90


@pytest.fixture
def table(tmp_path):
    """Held inputs, three rows each, 0.1 s apart, on which an Euler unicycle is off by up to 1 mm in x; by the model's names."""
    lines = ["segment,t,x,y,theta,v,w"]
    for i in range(RUNS):
        lines += [f"{i},{0.1 * k:.1f},{0.02 * k + (1e-3 * (i + 1) / RUNS if k else 0.0)!r},0,0,0.2,0" for k in range(3)]
    path = tmp_path / "plain.csv"
    path.write_text("\n".join(lines) + "\n")
    return path


@pytest.fixture
def renamed(table):
    """The same by the names of a robot's own topics."""
    header, rows = table.read_text().split("\n", 1)
    path = table.with_name("named.csv")
    path.write_text(",".join(NAMES.get(name, name) for name in header.split(",")) + "\n" + rows)
    return path


def _answer(capsys, verb, *argv):
    few = ("--epsilon", "0.05") if verb == "gap" else ()  # for what so few samples say
    assert main([verb, *(str(a) for a in argv), *few]) == 0
    return json.loads(capsys.readouterr().out)


@pytest.mark.slow
@pytest.mark.parametrize("verb", ["gap", "trace"])
def test_a_table_by_other_names_says_the_same(table, renamed, verb, capsys):
    plain = _answer(capsys, verb, table, *MODEL, "--json")
    named = _answer(capsys, verb, renamed, *MODEL, *COLUMNS, "--json")
    differ = {key for key in plain.keys() | named.keys() if plain.get(key) != named.get(key)}
    assert {key for key in differ if not re.search("digest|source|recording", key)} == set()


@pytest.mark.slow
def test_the_recording_that_is_judged_on_has_the_same_columns(renamed, capsys):
    other = renamed.with_name("other.csv")
    other.write_text(renamed.read_text() + f"{RUNS},0.0,0,0,0,0.2,0\n{RUNS},0.1,0.02,0,0,0.2,0\n")
    found = _answer(capsys, "trace", renamed, *MODEL, *COLUMNS, "--test", other, "--json")
    assert found["n_test"] == (RUNS + 1) * 2 - 1  # the two rows more, and one transition less in them


def test_it_is_asked_instead_of_what_a_profile_says(renamed, table, tmp_path, capsys):
    profile = tmp_path / "robot.toml"
    columns = ", ".join(f'{name} = "elsewhere"' if name == "v" else f'{name} = "{column}"' for name, column in NAMES.items())
    profile.write_text(f"columns = {{ {columns} }}\n{ROBOTARIUM.read_text()}")
    assert main(["gap", str(renamed), "--profile", str(profile), *MODEL]) == 2
    assert "lacks the column 'elsewhere'" in capsys.readouterr().err
    assert _answer(capsys, "gap", renamed, "--profile", profile, *MODEL, "--column", "v=cmd_vel.linear.x", "--json")["n"] == RUNS


@pytest.mark.parametrize(
    ("columns", "words"),
    [
        (["speed=a"], ("no state or input 'speed'", "x, y, theta, v, w")),
        (["x"], ("--column x", "must be NAME=COLUMN")),
        (["x="], ("--column x=", "must be NAME=COLUMN")),
        (["=a"], ("--column =a", "must be NAME=COLUMN")),
        (["x=a", "x=b"], ("--column x=b", "x is in 'a' already")),
        (["x=y"], ("--column x=y", "the column of y, too", "--column y=COLUMN")),
        (["v=speed", "w=speed"], ("--column v=speed", "the column of w, too")),
        (["x=t"], ("--column x=t", "the column of t, too")),
        (["x=segment"], ("column 'segment' has the runs, can be no state or input",)),
        (["x=pose.x"], ("lacks the column 'pose.x'",)),
    ],
)
@pytest.mark.parametrize("verb", ["gap", "trace"])
def test_what_is_no_mapping_gets_a_line(table, verb, columns, words, capsys):
    assert main([verb, str(table), *MODEL, *(part for item in columns for part in ("--column", item))]) == 2
    told = capsys.readouterr()
    assert told.out == ""
    assert len(told.err.strip().splitlines()) == 1
    assert all(word in told.err for word in words), told.err


def test_two_columns_may_be_exchanged(table, capsys):
    crossed = table.with_name("crossed.csv")
    crossed.write_text(table.read_text().replace(",x,y,", ",y,x,", 1))
    plain, wrong = (_answer(capsys, "gap", path, *MODEL, "--json")["radius"] for path in (table, crossed))
    right = _answer(capsys, "gap", crossed, *MODEL, "--column", "x=y", "--column", "y=x", "--json")["radius"]
    assert right == plain < wrong


@pytest.mark.slow
@pytest.mark.parametrize("verb", ["gap", "trace"])
def test_the_stamps_may_have_another_name_too(table, verb, capsys):
    stamped = table.with_name("stamped.csv")
    stamped.write_text(table.read_text().replace("segment,t,", "segment,time,", 1))
    plain = _answer(capsys, verb, table, *MODEL, "--json")
    named = _answer(capsys, verb, stamped, *MODEL, "--column", "t=time", "--json")
    what = "gap" if verb == "trace" else "radius"
    assert named[what] == plain[what]
    guessed = _answer(capsys, verb, stamped, *MODEL, "--json")
    assert guessed[what] == plain[what]
    assert guessed["notes"] == ["'time' is read as t (if it is another column: --column NAME=COLUMN)"]


@pytest.mark.parametrize("verb", ["gap", "trace"])
def test_a_log_has_its_names(tmp_path, verb, capsys):
    log = tmp_path / "drive.of.today"
    log.write_bytes(b"\x89MCAP0\r\n")
    assert main([verb, str(log), *MODEL, "--column", "x=a"]) == 2
    assert "is a log, whose states and inputs have their names" in capsys.readouterr().err


@pytest.mark.parametrize("verb", ["gap", "trace"])
def test_a_file_that_is_not_there_says_so(tmp_path, verb, capsys):
    assert main([verb, str(tmp_path / "none.mcap"), *MODEL, "--column", "x=a"]) == 2
    assert "No such file" in capsys.readouterr().err


def test_the_daemon_knows_its_own(capsys):
    assert main(["trace", "--live", "drive", "--column", "x=a"]) == 2
    assert "--column: the daemon traces as its profile says" in capsys.readouterr().err
