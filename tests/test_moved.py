"""Import paths of version 0.1 load the same modules from their new places, with a warning."""

import importlib
import subprocess
import sys

import pytest

from s2r_runtime.moved import MOVED


@pytest.mark.parametrize("old", [*sorted(MOVED), "formats.sizes", "stl.text"])
def test_an_old_path_is_the_new_module_and_warns(old: str, monkeypatch: pytest.MonkeyPatch) -> None:
    first, _, inside = old.partition(".")
    new = importlib.import_module(f"s2r_runtime.{MOVED[first]}{'.' + inside if inside else ''}")
    for name in [name for name in sys.modules if name.startswith(f"s2r_runtime.{first}")]:
        monkeypatch.delitem(sys.modules, name)

    with pytest.warns(DeprecationWarning, match="the old name goes with the next version"):
        assert importlib.import_module(f"s2r_runtime.{old}") is new

    assert new.__spec__ is not None
    assert new.__spec__.name == new.__name__


def test_a_name_that_never_was_is_not_found() -> None:
    with pytest.raises(ModuleNotFoundError, match=r"s2r_runtime\.nothing"):
        importlib.import_module("s2r_runtime.nothing")


def test_without_an_old_name_nobody_is_warned() -> None:
    code = "import s2r_runtime.plugins as p; p.registry().names('transports')"
    done = subprocess.run(
        [sys.executable, "-W", "error::DeprecationWarning:s2r_runtime", "-c", code], capture_output=True, text=True, check=False
    )
    assert (done.returncode, done.stderr) == (0, "")
