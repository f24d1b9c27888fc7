"""Where the tracer's public names are imported from, and the paths that earlier versions documented."""

import importlib
import subprocess
import sys

import pytest

package = importlib.import_module("s2r_runtime.trace")


@pytest.mark.parametrize("name", package.__all__)
def test_a_public_name_is_imported_from_the_package(name):
    assert getattr(package, name) is not None


def test_an_unknown_name_is_an_ordinary_error():
    with pytest.raises(AttributeError, match="no_such_name"):
        package.no_such_name  # noqa: B018


def test_the_version_alone_loads_no_numerical_library():
    code = "import sys; from s2r_runtime.trace import VERSION; sys.exit('numpy' in sys.modules or 'scipy' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0


@pytest.mark.parametrize(
    ("path", "names"), [("tracer", ["trace", "load_dataset"]), ("dataset", ["from_arrays"]), ("excitation", ["suggest"])]
)
def test_a_documented_old_path_still_works_and_says_where_it_went(path, names):
    sys.modules.pop(f"s2r_runtime.trace.{path}", None)
    with pytest.warns(DeprecationWarning, match=rf"s2r_runtime.trace.{path} has moved"):
        old = importlib.import_module(f"s2r_runtime.trace.{path}")
    assert old.__all__ == sorted(names)
    assert all(getattr(old, name) is getattr(package, name) for name in names)
