"""What was digested is what runs: attacks on the way from a controller's file to its process, each with what comes of it."""

from __future__ import annotations

import compileall
import importlib
import os
import textwrap
from pathlib import Path

import numpy as np
import pytest
from confinement_rig import LANDLOCK
from controllers_rig import Hosted, hosted

from s2r_runtime.controllers.code import batch_control
from s2r_runtime.controllers.file import ControllerFile, load
from s2r_runtime.controllers.hosted import Reply, Stopped
from s2r_runtime.errors import ConfigError, ControllerError

GOOD = "import numpy as np\nfrom beside import K\ndef control(x, theta, parameters): return np.full((len(x), 2), K)\n"


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """A controller that answers 0.25, which stands in a module beside it."""
    (tmp_path / "controller.py").write_text(GOOD)
    (tmp_path / "beside.py").write_text("K = 0.25\n")
    return tmp_path


def answer(file: ControllerFile) -> float:
    """What the hosted controller wants to do."""
    with hosted(file) as it:
        reply = it.ask()
        assert isinstance(reply, Reply), reply
        return reply.u[0]


def test_files_that_are_changed_between_digest_and_start_change_nothing(folder: Path) -> None:
    file = load(folder / "controller.py")
    other = folder / "other.py"
    other.write_text("def control(x, theta, parameters): return x[:, :2] * 0 + 9\n")
    (folder / "controller.py").unlink()
    (folder / "controller.py").symlink_to(other)
    (folder / "beside.py").write_text("K = 9.0\n")
    (folder / "beside").mkdir()
    (folder / "beside" / "__init__.py").write_text("K = 9.0\n")
    assert answer(file) == 0.25
    assert load(folder / "controller.py").digest != file.digest


def test_bytecode_that_is_planted_beside_it_does_not_run(folder: Path) -> None:
    stamp = (folder / "beside.py").stat()
    (folder / "beside.py").write_text("K = 9.00\n")
    assert compileall.compile_dir(folder, quiet=1)
    planted = next((folder / "__pycache__").glob("beside.*.pyc"))
    (folder / "beside.py").write_text("K = 0.25\n")
    os.utime(folder / "beside.py", ns=(stamp.st_atime_ns, stamp.st_mtime_ns))
    data = bytearray(planted.read_bytes())
    data[8:16] = int(stamp.st_mtime).to_bytes(4, "little") + stamp.st_size.to_bytes(4, "little")  # PEP 552: it looks up to date
    planted.write_bytes(data)
    (folder / "beside.pyc").write_bytes(data)
    assert answer(load(folder / "controller.py")) == 0.25


def test_no_variable_and_no_customization_of_the_daemons_user_reaches_it(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    planted = folder / "planted"
    planted.mkdir()
    for name in ("sitecustomize", "usercustomize", "beside", "numpy", "s2r_runtime", "msgspec", "json"):
        (planted / f"{name}.py").write_text("import os; os._exit(99)\n")
    for name in ("PYTHONPATH", "PYTHONHOME", "PYTHONSTARTUP", "PYTHONUSERBASE", "LD_PRELOAD", "LD_LIBRARY_PATH", "PYTHONBREAKPOINT"):
        monkeypatch.setenv(name, str(planted))
    monkeypatch.chdir(planted)
    assert answer(load(folder / "controller.py")) == 0.25


def test_a_module_that_is_imported_late_is_the_one_that_was_digested(folder: Path) -> None:
    source = "import numpy as np\ndef control(x, theta, parameters):\n    import beside\n    return np.full((len(x), 2), beside.K)\n"
    (folder / "controller.py").write_text(source)
    with hosted(load(folder / "controller.py")) as it:
        (folder / "beside.py").write_text("K = 9.0\n")
        reply = it.ask()
        assert isinstance(reply, Reply)
        assert reply.u[0] == 0.25


def test_a_module_that_no_statement_names_is_not_there(folder: Path) -> None:
    (folder / "hidden.py").write_text("K = 9.0\n")
    source = "import importlib\ndef control(x, theta, parameters): return x[:, :2] * importlib.import_module('hid' + 'den').K\n"
    (folder / "controller.py").write_text(source)
    with hosted(load(folder / "controller.py")) as it:
        stopped = it.ask()
        assert isinstance(stopped, Stopped)
        assert "No module named 'hidden'" in stopped.detail


@pytest.mark.slow
@pytest.mark.skipif(not LANDLOCK, reason="this kernel has no Landlock")
def test_parameters_that_it_would_read_from_a_file_end_it(folder: Path) -> None:
    (folder / "gains.txt").write_text("0.25")
    where = "float(open({!r}).read())".format(str(folder / "gains.txt"))
    (folder / "controller.py").write_text(f"def control(x, theta, parameters): return x[:, :2] * 0 + {where}\n")
    with hosted(load(folder / "controller.py")) as it:
        stopped = it.ask()
    assert isinstance(stopped, Stopped)
    assert stopped.reason == "raised"
    assert "a controller opens no files: what it needs stands in its PARAMETERS, or in a module beside it" in stopped.detail
    (folder / "controller.py").write_text(f"K = {where}\ndef control(x, theta, parameters): return x[:, :2] * K\n")
    it = Hosted(load(folder / "controller.py"))
    stopped = it.next()
    it.host.close()
    assert isinstance(stopped, Stopped)
    assert stopped.reason == "start_failed"


def test_a_library_that_is_changed_where_it_is_developed_is_another_one(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """An editable installation: its version says nothing about its code."""
    site, project = tmp_path / "site", tmp_path / "project"
    about = site / "gaitlib-1.2.dist-info"
    (project / "gaitlib").mkdir(parents=True)
    about.mkdir(parents=True)
    (about / "METADATA").write_text("Metadata-Version: 2.1\nName: gaitlib\nVersion: 1.2\n")
    (about / "top_level.txt").write_text("gaitlib\n")
    (about / "direct_url.json").write_text(f'{{"dir_info": {{"editable": true}}, "url": "file://{project}"}}')
    (project / "gaitlib" / "__init__.py").write_text("from gaitlib.deep import K\n")
    (project / "gaitlib" / "deep.py").write_text("K = 0.25\n")
    monkeypatch.syspath_prepend(str(project))
    monkeypatch.syspath_prepend(str(site))
    importlib.invalidate_caches()
    path = tmp_path / "controller.py"
    path.write_text("import gaitlib\ndef control(x, theta, parameters): return x[:, :2] * 0 + gaitlib.K\n")
    file = load(path)
    assert file.libraries["gaitlib"].startswith("1.2 sha256:")
    np.testing.assert_array_equal(batch_control(file)(np.zeros((1, 3)), {}), [[0.25, 0.25]])
    (project / "gaitlib" / "deep.py").write_text("K = 9.00\n")
    assert load(path).digest != file.digest
    with pytest.raises(ControllerError, match=r"digested with gaitlib 1\.2 sha256:\w+, here is 1\.2 sha256:"):
        batch_control(file)


def test_code_behind_a_link_of_a_library_under_development_counts_and_a_ring_of_links_ends(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    site, project, shared = tmp_path / "site", tmp_path / "project", tmp_path / "shared" / "deep"
    about = site / "linklib-1.0.dist-info"
    for folder in (project / "linklib", about, shared, tmp_path / "other"):
        folder.mkdir(parents=True)
    (about / "METADATA").write_text("Metadata-Version: 2.1\nName: linklib\nVersion: 1.0\n")
    (about / "top_level.txt").write_text("linklib\n")
    (about / "direct_url.json").write_text(f'{{"dir_info": {{"editable": true}}, "url": "file://{project}"}}')
    (project / "linklib" / "__init__.py").write_text("from linklib.deep.gain import K\n")
    (shared / "__init__.py").write_text("")
    (shared / "gain.py").write_text("K = 0.25\n")
    (project / "linklib" / "deep").symlink_to(shared)
    (shared / "ring").symlink_to(project / "linklib")
    monkeypatch.syspath_prepend(str(project))
    monkeypatch.syspath_prepend(str(site))
    importlib.invalidate_caches()
    path = tmp_path / "controller.py"
    path.write_text("import linklib\ndef control(x, theta, parameters): return x[:, :2] * 0 + linklib.K\n")
    found = {load(path).digest}
    (shared / "gain.py").write_text("K = 9.00\n")
    found.add(load(path).digest)
    (tmp_path / "other" / "gain.py").write_text("K = 8.00\n")
    (project / "linklib" / "deep").unlink()
    (project / "linklib" / "deep").symlink_to(tmp_path / "other")
    found.add(load(path).digest)
    (project / "linklib" / "more").symlink_to(tmp_path / "other")  # the same code, under another name
    found.add(load(path).digest)
    assert len(found) == 4


def test_a_library_that_changes_while_the_controller_starts_is_noticed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "controller.py"
    path.write_text("import numpy\ndef control(x, theta, parameters): return x[:, :2]\n")
    file, versions = load(path), iter([load(path).libraries["numpy"], "0.1"])
    monkeypatch.setattr("s2r_runtime.controllers.file.version", lambda _: next(versions))
    with pytest.raises(ControllerError, match=r"while it was started, was digested with numpy .*, here is 0\.1"):
        batch_control(file)


@pytest.mark.parametrize("what", ["device", "pipe", "folder", "endless module"])
def test_what_is_no_file_is_refused_and_not_waited_for(tmp_path: Path, what: str) -> None:
    path = tmp_path / "controller.py"
    if what == "device":
        path.symlink_to("/dev/zero")
    elif what == "pipe":
        os.mkfifo(path)
    elif what == "folder":
        path.mkdir()
    else:
        path.write_text(textwrap.dedent(GOOD))
        os.truncate(os.open(tmp_path / "beside.py", os.O_CREAT | os.O_RDWR), 1 << 40)
    with pytest.raises(ConfigError, match=r"is no file|directory|has more than"):
        load(path)
