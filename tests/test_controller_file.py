"""A controller's file: what its digest covers, what it may import, and what is said where something is wrong."""

from __future__ import annotations

import subprocess
import sys
import textwrap
from pathlib import Path

import msgspec
import pytest

from s2r_runtime.controllers.file import load
from s2r_runtime.errors import ConfigError

GOOD = """
import numpy as np
PARAMETERS = {"gain": 1.5, "steps": 3}
def control(x, theta, parameters):
    return np.stack([parameters["gain"] * x[:, 0], x[:, 1]], axis=1)
"""


def write(folder: Path, source: str, name: str = "controller.py") -> Path:
    path = folder / name
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(textwrap.dedent(source))
    return path


def test_the_digest_covers_all_that_decides_what_runs_and_not_where_it_lies(tmp_path: Path) -> None:
    first = load(write(tmp_path / "a", GOOD))
    assert load(write(tmp_path / "b", GOOD, "other_name.py")).digest == first.digest
    assert load(write(tmp_path / "c", GOOD + "\n")).digest != first.digest
    assert load(tmp_path / "a" / "controller.py", {"gain": 1.6}).digest != first.digest
    for change in (
        {"libraries": {"numpy": "0.1"}},
        {"python": "CPython 2.7"},
        {"entry": "other"},
        {"modules": {"m": b""}},
        {"packages": ("m",)},
        {"absent": ("m",)},
    ):
        assert msgspec.structs.replace(first, **change).digest != first.digest
    assert first.as_found_here().digest == first.digest


def test_the_digest_covers_modules_beside_the_controller_and_their_imports(tmp_path: Path) -> None:
    write(tmp_path, "import maps.grid\nfrom maps import colours\nfrom plain import f\ndef control(x, theta, parameters): return f(x)")
    write(tmp_path, "import scipy\nfrom .tools import size\nfrom . import deep\n", "maps/grid.py")
    write(tmp_path, "", "maps/__init__.py")
    write(tmp_path, "size = 1", "maps/tools.py")
    write(tmp_path, "", "maps/colours.py")
    write(tmp_path, "from ..tools import size", "maps/deep/__init__.py")
    write(tmp_path, "def f(x): return x[:, :2]", "plain.py")
    write(tmp_path, "unused", "other.py")
    file = load(tmp_path / "controller.py")
    assert sorted(file.modules) == ["maps", "maps.colours", "maps.deep", "maps.grid", "maps.tools", "plain"]
    assert file.packages == ("maps", "maps.deep")
    assert set(file.libraries) == {"scipy"}
    digest = file.digest
    for changed in ("maps/tools.py", "maps/deep/__init__.py", "plain.py"):
        path = tmp_path / changed
        kept = path.read_text()
        path.write_text(kept + "\n# another\n")
        assert load(tmp_path / "controller.py").digest != digest
        path.write_text(kept)
    assert load(tmp_path / "controller.py").digest == digest


def test_parameters_are_read_without_running_and_overridden_by_name(tmp_path: Path) -> None:
    path = write(tmp_path, GOOD + "\nraise RuntimeError('not run')\n")
    assert load(path).parameters == {"gain": 1.5, "steps": 3}
    given = load(path, {"gain": 2, "steps": 4.0}).parameters
    assert given == {"gain": 2.0, "steps": 4}
    assert isinstance(given["gain"], float)
    assert isinstance(given["steps"], int)
    with pytest.raises(ConfigError, match="has no parameter 'gian'; it has: gain, steps"):
        load(path, {"gian": 1.0})
    with pytest.raises(ConfigError, match="parameter gain is 'fast', must be a number as in the file"):
        load(path, {"gain": "fast"})
    with pytest.raises(ConfigError, match="parameter gain is inf, must be finite"):
        load(path, {"gain": float("inf")})


@pytest.mark.parametrize(
    ("source", "message"),
    [
        ("def control(x, theta, parameters)\n    return x", "line 1: expected ':'"),
        ("def f(x): return x", r"has no function control; must have def control\(x, theta, parameters\); it has: f"),
        ("", "has no function control"),
        ("def control(x, theta): return x", "line 1: control must take three arguments"),
        ("def control(a, b, c, d): return a", "control must take three arguments"),
        ("def control(a, b, c, *, d): return a", "control must take three arguments"),
        ("def control(a, b, c): return a\ndef control(a, b, c): return a", "line 2: a second control"),
        ("PARAMETERS = dict(a=1)\ndef control(a, b, c): return a", "line 1: PARAMETERS must be a literal dict"),
        ("PARAMETERS = [1]\ndef control(a, b, c): return a", "PARAMETERS must be a literal dict"),
        ("PARAMETERS = {1: 2}\ndef control(a, b, c): return a", "PARAMETERS must be a literal dict with text keys"),
        ("PARAMETERS = {'a': 1e999}\ndef control(a, b, c): return a", "parameter a is inf, must be finite"),
        ("PARAMETERS = {'a': {1, 2}}\ndef control(a, b, c): return a", r"parameter a is \{1, 2\}, must be numbers"),
        ("PARAMETERS = {}\nPARAMETERS = {}\ndef control(a, b, c): return a", "line 2: PARAMETERS is set a second time"),
        ("import nothing_like_it\ndef control(a, b, c): return a", "line 1: imports nothing_like_it, which is neither beside"),
        ("from . import beside\ndef control(a, b, c): return a", "line 1: 'from . import ...' leaves the controller's folder"),
        ("from ..up import x\ndef control(a, b, c): return a", r"'from ..up import ...' leaves"),
        ("import random\ndef control(a, b, c): return a", "imports random, which is .* and also a module of Python; rename"),
        ("import pluggy\ndef control(a, b, c): return a", "imports pluggy, which is .* and also .*site-packages.*; rename"),
        ("import package.missing\ndef control(a, b, c): return a", "imports package.missing, but .* is not there"),
        ("import package.broken\ndef control(a, b, c): return a", r"broken\.py: line 1: "),
        ("\0", "is no Python source|source code"),
    ],
)
def test_what_is_wrong_with_a_controller_is_said_in_one_line(tmp_path: Path, source: str, message: str) -> None:
    for name in ("random.py", "pluggy.py", "package/__init__.py"):
        write(tmp_path, "", name)
    write(tmp_path, "def", "package/broken.py")
    path = write(tmp_path, source)
    with pytest.raises(ConfigError, match=message) as refused:
        load(path)
    assert "\n" not in str(refused.value)


def test_a_missing_controller_is_named(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"none\.py: cannot be read: No such file"):
        load(tmp_path / "none.py")


def test_a_library_that_may_be_missing_is_part_of_the_digest(tmp_path: Path) -> None:
    source = """
        from typing import TYPE_CHECKING
        try:
            import a_faster_library
        except ImportError:
            a_faster_library = None
        if TYPE_CHECKING:
            import only_for_types
        def control(x, theta, parameters): return x[:, :2]
    """
    assert load(write(tmp_path, source)).absent == ("a_faster_library", "only_for_types")


def test_the_daemon_loads_controllers_without_numpy() -> None:
    loaded = "s2r_runtime.controllers.hosted, s2r_runtime.trust.certificate, s2r_runtime.daemon.persistence"
    code = f"import sys, {loaded}; print('numpy' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout.strip() == "False"
