"""What `s2r plugin new` writes installs, passes its kit and works as it is; what can't be written is refused in one line."""

from __future__ import annotations

import json
import os
import re
import socket
import subprocess
import sys
import time
import tomllib
from pathlib import Path

import pytest

from s2r_runtime.cli.plugin_files import KINDS, TEMPLATES

ROOT = Path(__file__).parent.parent
PAGE = (ROOT / "docs" / "plugin-author.md").read_text(encoding="utf-8")
REFERENCE = (ROOT / "docs" / "plugin-reference.md").read_text(encoding="utf-8")
FOLLOWS = re.findall(
    r"^```python[^\n]*\n(.*?)^```$", REFERENCE[REFERENCE.index("## A program that follows the log") :], re.MULTILINE | re.DOTALL
)[0]
PACKAGES = [kind for kind in KINDS if kind != "controller"]


class Site:
    """A folder on the path with packages as an installer leaves them, and a place for everything that a daemon keeps."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.path = [str(ROOT)]
        self.environment = {**os.environ, "NO_COLOR": "1", "OMP_NUM_THREADS": "1"}
        self.environment |= {"XDG_RUNTIME_DIR": str(folder), "XDG_STATE_HOME": str(folder / "home")}

    def run(self, *words: str, cwd: Path | None = None) -> subprocess.CompletedProcess[str]:
        return subprocess.run(
            [sys.executable, *words], cwd=cwd or self.folder, env=self.env(), capture_output=True, text=True, timeout=200, check=False
        )

    def env(self) -> dict[str, str]:
        return {**self.environment, "PYTHONPATH": os.pathsep.join(self.path)}

    def s2r(self, *words: str, cwd: Path | None = None) -> subprocess.CompletedProcess[str]:
        return self.run("-m", "s2r_runtime.cli.main", *words, cwd=cwd)

    def spawn(self, *words: str, cwd: Path) -> subprocess.Popen[bytes]:
        with (self.folder / "said.txt").open("ab") as said:
            return subprocess.Popen([sys.executable, *words], cwd=cwd, env=self.env(), stdout=said, stderr=said)

    def install(self, project: Path) -> None:
        """What `pip install -e` does: the folder is on the path, with its metadata."""
        read = tomllib.loads((project / "pyproject.toml").read_text())["project"]
        name = f"{read['name'].replace('-', '_')}-{read['version']}"
        info = project / f"{name}.dist-info"
        info.mkdir()
        (info / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {read['name']}\nVersion: {read['version']}\n")
        lines = [f"[{group}]\n" + "\n".join(f"{k} = {v}" for k, v in points.items()) for group, points in read["entry-points"].items()]
        (info / "entry_points.txt").write_text("\n".join(lines) + "\n")
        self.path.append(str(project))


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Site:
    """One of each kind, called a_KIND."""
    site = Site(tmp_path_factory.mktemp("site"))
    for kind in KINDS:
        done = site.s2r("plugin", "new", f"a_{kind}", "--kind", kind)
        assert done.returncode == 0, done.stderr
        assert {line.partition("/")[0] for line in done.stdout.splitlines()} == {f"a_{kind}"}
    for kind in PACKAGES:
        site.install(site.folder / f"a_{kind}")
    return site


@pytest.mark.slow
def test_every_kind_can_be_written_and_its_own_tests_pass(site: Site) -> None:
    folders = [str(site.folder / f"a_{kind}") for kind in KINDS if kind != "transport"]
    done = site.run("-m", "pytest", "-q", "-p", "no:cacheprovider", "--import-mode=importlib", "-W", "error", *folders)
    assert done.returncode == 0, done.stdout[-3000:]
    for folder in folders:
        text = "".join(path.read_text() for path in Path(folder).rglob("*") if path.suffix in (".py", ".toml", ".md"))
        assert not re.search(r"my.?thing", text, re.IGNORECASE)
        assert Path(folder, "README.md").exists()


@pytest.mark.slow
def test_transport_is_a_hundred_lines_at_most_and_its_tests_are_the_kit(site: Site) -> None:
    listed = site.run("-m", "pytest", "-q", "-p", "no:cacheprovider", "--collect-only", str(site.folder / "a_transport"))
    assert "test_lost_robot_is_reported_and_its_return_too" in listed.stdout
    assert len((TEMPLATES / "transport" / "my_thing" / "transport.py").read_text().splitlines()) <= 100


@pytest.mark.slow
def test_list_says_where_each_comes_from(site: Site) -> None:
    listed = site.s2r("plugin", "list")
    assert listed.returncode == 0, listed.stdout
    for kind in PACKAGES:
        assert f"a_{kind}  in use\n    from a-{kind} 0.1.0, API 1, {site.folder}/a_{kind}/a_{kind}/plugin.py" in listed.stdout
    found = {p["name"]: p for p in json.loads(site.s2r("plugin", "list", "--json").stdout)["plugins"]}
    assert found["a_task"]["offers"] == {"tasks": ["a_task"], "kits": ["tasks.a_task"]}


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["transport", "effect", "recording"])
def test_check_runs_the_kit_of_what_is_offered(site: Site, kind: str) -> None:
    done = site.s2r("plugin", "check", f"a_{kind}", "--json")
    found = json.loads(done.stdout)
    assert (done.returncode, found["ok"], found["error"]) == (0, True, ""), done.stdout
    (row,) = found["offers"]
    assert row["failed"] == []
    if kind == "transport":
        assert re.search(rf"^transports my_bus +{row['passed']} +{row['skipped']} +0$", PAGE, re.MULTILINE), "the page shows other numbers"
    assert row["passed"] >= {"transport": 20, "effect": 8, "model": 10, "task": 10}.get(kind, 1)


def port() -> int:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as s:
        s.bind(("127.0.0.1", 0))
        return int(s.getsockname()[1])


@pytest.mark.slow
def test_the_new_transport_is_sampled_with_the_robot_that_comes_with_it_and_its_log_followed(site: Site) -> None:
    project, (ours, robots) = site.folder / "a_transport", (port(), port())
    profile = project / "a_transport.toml"
    profile.write_text(profile.read_text().replace("7481", str(ours)).replace("7482", str(robots)))
    robot = site.spawn("-m", "a_transport.robot", "--port", str(ours), "--robot-port", str(robots), "--gain", "0.9", cwd=project)
    daemon = site.spawn("-m", "s2r_runtime.cli.main", "run", "a_transport.toml", cwd=project)
    try:
        end = time.monotonic() + 60.0
        while '"link": true' not in site.s2r("status", "--json").stdout:
            assert time.monotonic() < end, (site.folder / "said.txt").read_text()
            time.sleep(0.2)
        assert site.s2r("permit", "600").returncode == 0
        done = site.s2r("sample", "a_transport.toml", "--json", cwd=project)
        assert done.returncode == 0, done.stdout + done.stderr
        status = json.loads(site.s2r("status", "--json").stdout)
        (site.folder / "follow.py").write_text(FOLLOWS)
        with subprocess.Popen(
            [sys.executable, "follow.py", status["log"]], cwd=site.folder, env=site.env(), stdout=subprocess.PIPE
        ) as follows:
            assert site.s2r("stop").returncode == 0
            told = []
            while told[-1:] != [b"closed emergency_stop\n"]:
                told.append(follows.stdout.readline())  # type: ignore[union-attr]
            follows.kill()
        assert b"closed no_controller\n" in told
    finally:
        daemon.terminate()
        ended = daemon.wait(30.0)
        robot.kill()
        robot.wait()
    assert ended == 0
    counters = status["counters"]
    assert counters["malformed"] == counters["lost"] == counters["dropped_in"] == counters["dropped_out"] == 0
    # a tenth of the yaw rate is missing: 0.1 * 3.1 rad/s * 0.033 s * 0.0525 m/rad at most, and measurement noise on top
    assert 0.0003 < status["gap_radius"] < 0.1 * 3.1 * 0.033 * 0.0525 + 0.001


@pytest.mark.slow
def test_controller_is_verified_on_the_profile_that_comes_with_it(site: Site) -> None:
    project = site.folder / "a_controller"
    done = site.s2r("verify", "a_controller.py", "--profile", "a_controller.toml", "--radius", "0.001", "--json", cwd=project)
    assert (done.returncode, json.loads(done.stdout)["passed"]) == (0, True), done.stdout + done.stderr


@pytest.mark.slow
def test_log_reader_is_used_for_its_files(site: Site) -> None:
    lines = [
        f"{k * 0.1:.1f} x {0.02 * k}\n{k * 0.1:.1f} y 0\n{k * 0.1:.1f} theta 0\n{k * 0.1:.1f} v 0.2\n{k * 0.1:.1f} w 0\n"
        for k in range(300)
    ]
    (site.folder / "run.a_recording").write_text("".join(lines))
    done = site.s2r("gap", "run.a_recording", "--model", "unicycle", "--dt", "0.1", "--json")
    found = json.loads(done.stdout)
    assert done.returncode == 3, "ordinary driving: the numbers, but no statement"
    assert found["radius"] < 1e-6


@pytest.mark.parametrize(
    ("words", "why"),
    [
        (("A-Bus",), "NAME is 'A-Bus', must be a small letter, then small letters, digits and _, 40 at most"),
        (("../up",), "must be a small letter"),
        (("json",), "NAME is 'json', which Python uses itself; choose another"),
        (("class",), "which Python uses itself"),
        (("zenoh",), "NAME is 'zenoh', but s2r-zenoh has a transport of that name; choose another"),
        (("numpy",), "NAME is 'numpy', but a package of that name is installed here; choose another"),
        (("good", "--to", "there"), "there: is there already; name another folder with --to, or another plug-in"),
        (("good", "--to", "file/inside"), "file/inside: cannot be written: Not a directory"),
    ],
)
def test_what_cannot_be_written_is_refused_in_one_line_and_nothing_is_left(tmp_path: Path, words: tuple[str, ...], why: str) -> None:
    (tmp_path / "there").mkdir()
    (tmp_path / "file").touch()
    done = Site(tmp_path).s2r("plugin", "new", "--kind", "transport", *words)
    assert done.returncode == 2
    assert why in done.stderr
    assert len(done.stderr.splitlines()) == 1
    assert sorted(p.name for p in tmp_path.rglob("*")) == ["file", "there"]
