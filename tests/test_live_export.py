"""What viewers get of a log: quantities under their names, read by the official reader, in schemas that every message keeps to."""

from __future__ import annotations

import json
import math
import re
from pathlib import Path
from typing import Any

import jsonschema
import msgspec
import numpy as np
import pytest
from audit_bench import START_UNIX_S, Bench
from mcap.reader import make_reader

from s2r_runtime import messages as m
from s2r_runtime.cli.main import main
from s2r_runtime.live import scene
from s2r_runtime.plugins import registry
from s2r_runtime.recording.reading import read

NS = 1_000_000_000


@pytest.fixture(scope="module")
def log(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A campaign, its gap, and a controller that drives."""
    folder = tmp_path_factory.mktemp("log")
    return Bench(folder).sample().drive(60).stop().write(folder / "a.mcap")


@pytest.fixture(scope="module")
def exported(log: Path) -> dict[str, list[tuple[int, dict[str, Any]]]]:
    """Channel -> (log time, message), as the `mcap` package reads them; each message keeps to its channel's schema."""
    out = log.with_name("out.mcap")
    assert main(["export", str(log), "-o", str(out)]) == 0
    found: dict[str, list[tuple[int, dict[str, Any]]]] = {}
    with out.open("rb") as file:
        for schema, channel, message in make_reader(file, validate_crcs=True).iter_messages():
            assert schema is not None
            assert (schema.encoding, channel.message_encoding) == ("jsonschema", "json")
            data = json.loads(message.data)
            strict = _strict(json.loads(schema.data))
            if len(found.setdefault(channel.topic, [])) < 200:
                jsonschema.validate(data, strict)
            found[channel.topic].append((message.log_time, data))
    return found


def _strict(schema: dict[str, Any]) -> dict[str, Any]:
    """The schema, with no field beyond those that it names."""
    if schema.get("type") == "object" and schema.get("properties"):
        parts = {name: _strict(part) for name, part in schema["properties"].items()}
        return {**schema, "properties": parts, "additionalProperties": False}
    return {**schema, "items": _strict(schema["items"])} if schema.get("type") == "array" else schema


def messages(log: Path, kind: type[m.Struct]) -> list[Any]:
    return [entry.message for entry in read(log) if isinstance(entry.message, kind)]


def test_states_and_inputs_have_their_names(log: Path, exported: dict[str, Any]) -> None:
    seen = [one.observation for one in messages(log, m.Observed) if not one.observation.fault]
    assert [data for _, data in exported["/state"]] == [dict(zip(("x", "y", "theta"), o.x, strict=True)) for o in seen]
    sent = messages(log, m.Send)
    assert [data for _, data in exported["/input"]] == [{"v": s.u[0], "w": s.u[1], "source": s.source} for s in sent]


def test_a_pose_and_a_transform_are_those_of_the_state(exported: dict[str, Any]) -> None:
    for (t, state), (t_pose, pose), (t_tf, tf) in zip(exported["/state"], exported["/pose"], exported["/tf"], strict=True):
        q = pose["pose"]["orientation"]
        assert t == t_pose == t_tf == pose["timestamp"]["sec"] * NS + pose["timestamp"]["nsec"]
        assert (pose["pose"]["position"], pose["frame_id"]) == ({"x": state["x"], "y": state["y"], "z": 0.0}, "map")
        assert math.remainder(2.0 * math.atan2(q["z"], q["w"]) - state["theta"], 2.0 * math.pi) == pytest.approx(0.0, abs=1e-12)
        (moved,) = tf["transforms"]
        assert (moved["translation"], moved["rotation"]) == (pose["pose"]["position"], q)
        assert (moved["parent_frame_id"], moved["child_frame_id"]) == ("map", "bench")


def test_gate_gap_and_e_value_are_steady_series(log: Path, exported: dict[str, Any]) -> None:
    for name in ("/gate", "/watch"):
        times = np.array([t for t, _ in exported[name]])
        assert np.all(np.diff(times) >= 0)
        assert np.quantile(np.diff(times), 0.9) == pytest.approx(0.1 * NS)
    (_, first), (_, last) = exported["/watch"][0], exported["/watch"][-1]
    gap, measured = messages(log, m.EpochChanged)[-1].gap, messages(log, m.Measured)
    assert "gap" not in first
    assert last["gap_measured"] == gap.radius
    assert (last["e_value"], last["measured"]) in [(one.e_value, one.n) for one in measured[-3:]]
    changes = [(one.open, one.reason) for one in messages(log, m.GateChanged)]
    shown = [(bool(data["open"]), data["reason"]) for _, data in exported["/gate"]]
    assert [one for one in changes if one not in shown] == []


def test_the_residual_by_state_is_what_the_watch_measured(log: Path, exported: dict[str, Any]) -> None:
    gap = messages(log, m.EpochChanged)[-1].gap
    residual = {t: np.array([data[name] for name in ("x", "y", "theta")]) for t, data in exported["/residual"]}
    started = START_UNIX_S * NS
    measured = [one for one in messages(log, m.Measured) if not one.fault]
    assert len(measured) > 30
    for one in measured:
        e = residual[one.t_ns + started] * np.array(gap.weights)
        norm = float(np.linalg.norm(e)) if gap.set == "ball" else float(np.abs(e).max())
        assert norm == pytest.approx(one.discrepancy, rel=1e-9)


def test_times_are_the_wall_clock_at_the_start_of_the_run(log: Path, exported: dict[str, Any]) -> None:
    first = next(iter(read(log)))
    assert first.log_time_ns == first.message.t_ns  # type: ignore[attr-defined]
    assert all(series[0][0] >= START_UNIX_S * NS for series in exported.values())


def test_events_are_in_words(exported: dict[str, Any]) -> None:
    words = [data["message"] for _, data in exported["/events"]]
    assert any("gate open" in one for one in words)
    assert any("campaign of epoch 1 begins" in one for one in words)


@pytest.mark.parametrize("name", ["keep_out", "grid_world"])
def test_a_task_s_obstacles_and_goals_are_in_the_scene(name: str) -> None:
    from s2r_runtime.models.composed import compose
    from s2r_runtime.modelspec import ModelSpec

    model = compose(ModelSpec("unicycle", 0.05))
    task = registry().get("tasks", name)({}, model.nominal, model.dt)
    view = task.view(task.draw(np.random.default_rng(3), 1))
    goals, obstacles = scene.scenario(view, 5)
    places = {(round(c["pose"]["position"]["x"], 9), round(c["pose"]["position"]["y"], 9)) for c in goals["cylinders"]}
    given = np.asarray(view["goal"] if name == "keep_out" else view["goals"][0]).reshape(-1, 2)
    assert places == {(round(float(x), 9), round(float(y), 9)) for x, y in given}
    if name == "keep_out":
        (disc,) = obstacles["cylinders"]
        assert (disc["size"]["x"], disc["pose"]["position"]["x"]) == (0.5, view["disc"][0][0])
    else:
        assert (len(obstacles["cubes"]), len(obstacles["cylinders"])) == (10, 3)
        for cube in obstacles["cubes"]:  # a robot in the middle of a block touches it
            x = np.array([[cube["pose"]["position"]["x"], cube["pose"]["position"]["y"], 0.0]])
            assert task.clearance(x, task.draw(np.random.default_rng(3), 1))[0] < 0.0


def test_region_and_geofence_are_drawn_and_nothing_where_there_is_no_plane(log: Path) -> None:
    settings = messages(log, m.Started)[0].settings
    region, fence = scene.bounds(settings, 0)
    (x, y) = settings.region[:2]
    assert [(p["x"], p["y"]) for p in region["lines"][0]["points"]] == [(x[0], y[0]), (x[1], y[0]), (x[1], y[1]), (x[0], y[1])]
    assert fence["id"] == "geofence"
    assert scene.bounds(msgspec.structs.replace(settings, states=("q", "qd", "z")), 0) == []


def test_bad_calls_are_one_line(log: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "a.csv").write_text("t,x\n0,1\n")
    for argv, says, code in (
        (["export", str(tmp_path / "none.mcap"), "-o", str(tmp_path / "o.mcap")], "no such log file", 2),
        (["export", str(tmp_path / "a.csv"), "-o", str(tmp_path / "o.mcap")], "is no log of s2r", 2),
        (["export", str(log), "-o", str(log)], "would be lost", 2),
        (["export", str(log), "-o", str(tmp_path / "none" / "o.mcap")], "cannot be written", 2),
        (["live", "--foxglove", "99999", str(log)], "must be a port", 2),
        (["live", "--foxglove", str(tmp_path / "none.mcap")], "no such log file", 2),
        (["live", "--foxglove", "0", "--socket", str(tmp_path / "none.sock")], "none.sock", 2),
    ):
        assert main(argv) == code, argv
        said = capsys.readouterr().err
        assert says in said, (argv, said)
        assert said.count("\n") == 1, said
    assert list(tmp_path.iterdir()) == [tmp_path / "a.csv"]


def test_the_layout_shows_channels_and_fields_that_there_are(exported: dict[str, Any]) -> None:
    layout = json.loads((Path(__file__).parent.parent / "examples" / "foxglove" / "s2r.json").read_text(encoding="utf-8"))
    panels = re.findall(r'"(?:first|second)": "([^"]+)"', json.dumps(layout["layout"]))
    assert sorted(panels) == sorted(layout["configById"])
    shown = {topic for panel in layout["configById"].values() for topic in panel.get("topics", {})}
    shown |= {panel["topicToRender"] for panel in layout["configById"].values() if "topicToRender" in panel}
    for path in (path["value"] for panel in layout["configById"].values() for path in panel.get("paths", ())):
        topic, _, field = path.partition(".")
        assert any(field in data for _, data in exported[topic]), path
        shown.add(topic)
    assert shown | {"/tf"} == set(exported)
