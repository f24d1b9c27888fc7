"""`s2r.verify`, `certify`, `audit`, `read_log` and `connect` give what the command line gives."""

from __future__ import annotations

import json
import signal
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from audit_bench import Bench
from daemon_rig import Rig

import s2r_runtime as s2r
from s2r_runtime.cli.main import main
from s2r_runtime.trust import keys

ROOT = Path(__file__).parent.parent
GRID = ROOT / "controllers" / "grid.py"
PROFILE = """
[robot]
name = "rover"
[model]
name = "unicycle"
dt = 0.033
[region]
x = [-1.6, 1.6]
y = [-1.0, 1.0]
[inputs]
v = [-0.2, 0.2]
w = [-3.1, 3.1]
[norm]
weights = { theta = 0.0525 }
[guarantee]
epsilon = 0.05
beta = 0.2
[verification]
epsilon = 0.05
headroom = 1.0
[task]
name = "grid_world"
parameters = { static = 2 }
[transport]
name = "zenoh"
robot_listen = "tcp/127.0.0.1:7461"
"""
SAMPLES = 140


@pytest.fixture
def profile(tmp_path: Path) -> Path:
    path = tmp_path / "rover.toml"
    path.write_text(PROFILE)
    return path


def campaign(noise_m: float = 1e-5) -> dict[str, np.ndarray | list[int]]:
    """Independent transitions of the profile's model with a little noise, one segment each."""
    rng = np.random.default_rng(3)
    low, high = np.array([-1.5, -0.9, -3.0]), np.array([1.5, 0.9, 3.0])
    x = rng.uniform(low, high, (SAMPLES, 3))
    u = rng.uniform([-0.2, -3.1], [0.2, 3.1], (SAMPLES, 2))
    after = s2r.model("unicycle", dt=0.033).step(x, u) + rng.normal(scale=noise_m, size=x.shape)
    both = np.stack([x, after], axis=1).reshape(-1, 3)
    columns = dict(zip(("x", "y", "theta"), both.T, strict=True))
    inputs = dict(zip(("v", "w"), np.repeat(u, 2, axis=0).T, strict=True))
    return {"t": np.tile([0.0, 0.033], SAMPLES), **columns, **inputs, "segment": np.repeat(np.arange(SAMPLES), 2).tolist()}


# ---------------------------------------------------------------- controllers


def test_a_verification_is_that_of_the_command_line(profile: Path, capsys: pytest.CaptureFixture[str]) -> None:
    found = s2r.verify(GRID, profile=profile, radius=0.0005, law="uniform")
    assert main(["verify", str(GRID), "--profile", str(profile), "--radius", "0.0005", "--law", "uniform", "--json"]) == 0
    assert found.to_dict() == json.loads(capsys.readouterr().out)
    assert (found.passed, found.radius) == (True, 0.0005)
    assert found.summary().startswith("passed\n  uniform")
    pyplot = pytest.importorskip("matplotlib.pyplot")
    pyplot.switch_backend("agg")
    assert len(found.plot().patches) == 1
    pyplot.close("all")
    with pytest.raises(s2r.NotEnoughEvidence, match="n 3: "):
        s2r.verify(GRID, profile=profile, radius=0.0005, n=3)
    with pytest.raises(s2r.UsageError, match="side: must be one of: uniform"):
        s2r.verify(GRID, profile=profile, radius=0.0005, law="side")


@pytest.mark.slow
def test_a_certificate_is_paid_for_and_a_campaign_may_be_in_memory(profile: Path, tmp_path: Path) -> None:
    key = tmp_path / "signing.key"
    keys.new(key)
    recorded = campaign()
    assert s2r.gap(recorded, profile=profile).independent
    found = s2r.certify(GRID, profile=profile, recording=recorded, output=tmp_path / "cert.json", key=key)
    assert (found.passed, found.written, found.epoch) == (True, True, 1)
    assert found.to_dict()["certificate"] == str(tmp_path / "cert.json")
    assert (tmp_path / "cert.json").read_text().startswith("{")
    assert found.summary().endswith(f"certificate written to {tmp_path / 'cert.json'}")
    again = s2r.certify(GRID, profile=profile, recording=recorded, output=tmp_path / "cert.json", key=key)
    assert (again.epoch, again.verification.attempt) == (1, 2)
    assert again.beta_spent > found.beta_spent
    with pytest.raises(s2r.UsageError, match=r"output .*: is the profile, which would be lost"):
        s2r.certify(GRID, profile=profile, recording=recorded, output=profile, key=key)


# ---------------------------------------------------------------- logs and the daemon


@pytest.fixture(scope="module")
def rig(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Rig]:
    opened = Rig(tmp_path_factory.mktemp("rig"))
    opened.start_robot()
    opened.start()
    opened.until(lambda: opened.status()["observation"])
    yield opened
    opened.close()


def test_a_daemon_answers_in_python(rig: Rig, tmp_path: Path) -> None:
    with s2r.connect(socket=rig.socket) as daemon:
        status = daemon.status()
        assert (status["gate"], status["reason"]) == ("closed", "no_controller")
        permit = daemon.permit(60.0)
        assert (permit.ok, permit.text) == (True, "the sampler may drive for 60 s")
        refused = daemon.deploy(rig.controller())
        assert not refused.ok
        assert refused.summary().startswith("refused: ")
        stopped = daemon.stop()
        assert stopped.ok
        assert daemon.status()["reason"] == "emergency_stop"
        assert daemon.clear("emergency_stop").ok
        assert daemon.permit(0.0).text == "the sampler may not drive"
        with pytest.raises(s2r.UsageError, match="no controller is deployed"):
            daemon.undeploy()
        with pytest.raises(s2r.UsageError, match="is not latched"):
            daemon.clear("nothing")
        with pytest.raises(s2r.UsageError, match="no such file"):
            daemon.deploy(tmp_path / "none.py")
        with pytest.raises(s2r.NotEnoughEvidence, match="no finished campaign"):
            daemon.trace("campaign")
        with pytest.raises(s2r.UsageError, match="permit: seconds is nan, must be >= 0 and finite"):
            daemon.permit(float("nan"))


def page_block(name: str) -> str:
    """A block of docs/python.md that needs a daemon or its log."""
    page = (ROOT / "docs" / "python.md").read_text(encoding="utf-8")
    return page.split(f"```python no-run {name}\n")[1].split("\n```")[0]


def test_the_pages_lines_about_a_daemon_run(rig: Rig, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    rig.controller()
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(rig.folder))
    monkeypatch.chdir(rig.folder)
    exec(page_block("daemon"), {"s2r": s2r})  # noqa: S102 - the docs' own code
    out = capsys.readouterr().out.splitlines()
    assert out[0].startswith("closed no_controller ")
    assert out[1:] == ["the sampler may drive for 600 s", *out[2:-1], "emergency_stop"]
    assert out[2].startswith("False refused: ")


def test_an_interrupt_while_a_campaign_runs_stops_the_robot_and_keeps_it(rig: Rig) -> None:
    rig.ask("permit", duration_s=600.0)
    code = "import sys, s2r_runtime as s2r; s2r.connect(socket=sys.argv[1]).sample()"
    with subprocess.Popen([sys.executable, "-c", code, str(rig.socket)], stderr=subprocess.PIPE) as caller:
        rig.until(lambda: "samples" in str(rig.status()["campaign"]) or rig.status()["campaign"])
        caller.send_signal(signal.SIGINT)
        assert b"KeyboardInterrupt" in caller.communicate(timeout=60)[1]
    rig.until(lambda: "its command is gone" in rig.said())
    assert rig.ask("cancel")["exit_code"] == 0


def test_a_log_gives_its_channels_by_the_models_names(rig: Rig, capsys: pytest.CaptureFixture[str]) -> None:
    assert rig.stop() == 0
    (path,) = rig.log_files()
    log = s2r.read_log(path)
    assert main(["log", "info", str(path), "--json"]) == 0
    assert log.to_dict() == json.loads(capsys.readouterr().out)
    seen = log.arrays("event/observed")
    assert set(log.states) <= set(seen)
    assert {len(column) for column in seen.values()} == {log.channels["event/observed"]}
    assert seen["x"].dtype == np.float64
    assert seen["observation.seq"].dtype == np.int64
    assert np.all(np.diff(seen["t_s"]) >= 0.0)
    sent = log.arrays("out/send")
    assert {*log.inputs, "source", "obs_seq"} <= set(sent)
    closed = log.arrays("out/gate_changed")
    assert closed["open"].dtype == bool
    assert "emergency_stop" in closed["reason"]
    frame = pytest.importorskip("pandas") and log.frame("event/observed")
    assert list(frame.columns) == list(seen)
    with pytest.raises(s2r.UsageError, match="has no channel 'x'; it has: event/"):
        log.arrays("x")
    with pytest.raises(s2r.RecordingError, match=r"is part 1 of run"):
        s2r.read_log([path, path])


def test_the_pages_lines_about_a_log_run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    for library in ("pandas", "matplotlib"):
        pytest.importorskip(library)
    bench = Bench(tmp_path)
    bench.steps(40)
    bench.stop().write(tmp_path / "run.mcap")
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("MPLBACKEND", "agg")
    exec(page_block("log"), {"s2r": s2r})  # noqa: S102 - the docs' own code
    assert capsys.readouterr().out.splitlines()[-1] == "True intact None"


def test_a_damaged_log_is_refused_and_a_cut_one_is_read(rig: Rig, tmp_path: Path) -> None:
    data = rig.log_files()[0].read_bytes()
    cut, damaged = tmp_path / "cut.mcap", tmp_path / "damaged.mcap"
    cut.write_bytes(data[: len(data) * 2 // 3])
    middle = len(data) // 2
    damaged.write_bytes(data[:middle] + bytes([data[middle] ^ 1]) + data[middle + 1 :])
    assert s2r.read_log(cut).to_dict()["ended"] == "cut"
    assert len(s2r.read_log(cut).arrays("event/observed")["t_s"]) > 10
    with pytest.raises(s2r.RecordingError, match="is damaged at byte"):
        s2r.read_log(damaged)


def test_an_audit_is_that_of_the_command_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    bench = Bench(tmp_path)
    bench.steps(40)
    log = bench.stop().write(tmp_path / "a.mcap")
    found = s2r.audit(log)
    assert main(["audit", str(log), "--json"]) == found.exit_code
    assert found.to_dict() == json.loads(capsys.readouterr().out)
    assert found.summary().startswith("holds: " if found.ok else "DOES NOT HOLD: ")
