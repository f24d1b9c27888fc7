"""Plug-ins are found each on its own: one that is broken is reported with what it did, and never takes the others with it."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest

from s2r_runtime.errors import PluginError
from s2r_runtime.hookspecs import Offer, hookimpl
from s2r_runtime.plugins import Registry

ROOT = Path(__file__).parent.parent


def module(**hooks: Any) -> ModuleType:
    """A plug-in whose hooks give these values; an exception is raised; what is no hook is an attribute."""
    made = ModuleType("made")
    for name, value in hooks.items():
        if not name.startswith("s2r_"):
            setattr(made, name, value)
            continue

        def hook(value: Any = value) -> Any:
            if isinstance(value, BaseException):
                raise value
            return value

        hook.__name__ = name
        setattr(made, name, hookimpl(lambda value=value, hook=hook: hook(value)))
    return made


def offers(*names: str) -> list[Offer]:
    return [Offer(name, "json:loads") for name in names]


@pytest.mark.parametrize(
    ("hooks", "error"),
    [
        ({"s2r_transports": RuntimeError("no bus")}, "s2r_transports: RuntimeError: no bus"),
        ({"s2r_transports": SystemExit(1)}, "s2r_transports: SystemExit: 1"),
        ({"s2r_transports": 7}, "s2r_transports: TypeError: gives int, must be a list of Offer"),
        ({"s2r_transports": (offer for offer in ())}, "gives generator, must be a list of Offer"),
        ({"s2r_transports": ["bus"]}, "s2r_transports: offers str, must be Offer(name, target)"),
        ({"s2r_transports": [Offer("a bus", "json:loads")]}, "offers the name 'a bus', must be letters, digits, _ . -"),
        ({"s2r_transports": [Offer(7, "json:loads")]}, "offers the name 7"),  # type: ignore[arg-type]
        ({"s2r_transports": [Offer("bus", "json.loads")]}, "bus has the target 'json.loads', must be module:attribute"),
        ({"s2r_transports": [Offer("bus", "os:system('x')")]}, "must be module:attribute"),
    ],
)
def test_what_a_hook_may_not_do_is_reported_and_its_other_offers_are_in_use(hooks: dict[str, Any], error: str) -> None:
    found = Registry()
    found.add("odd", "odd-dist", "1.2", module(s2r_models=offers("cart"), **hooks))
    (loaded,) = found.loaded
    assert error in loaded.error
    assert loaded.offers == {"models": ("cart",)}
    assert found.names("transports") == []


def test_a_plug_in_for_another_version_of_the_interface_is_not_used() -> None:
    found = Registry()
    found.add("new", "new-dist", "3.0", module(S2R_API_VERSION=2, s2r_models=offers("cart")))
    found.add("now", "now-dist", "1.0", module(S2R_API_VERSION=1, s2r_models=offers("cart")))
    assert [(p.name, p.error, p.api) for p in found.loaded] == [
        ("new", "written for plug-in API 2, this is API 1", 0),
        ("now", "", 1),
    ]


def test_the_later_of_two_that_share_a_name_is_refused_and_both_are_named() -> None:
    found = Registry()
    found.add("one", "one-dist", "1", module(s2r_models=offers("cart", "bike", "bike")))
    found.add("two", "two-dist", "1", module(s2r_models=offers("boat", "cart")))
    found.add("one", "three-dist", "1", module(s2r_models=offers("ship")))
    errors = [p.error for p in found.loaded]
    assert errors == [
        "model 'bike' of one-dist is refused: one-dist has that name",
        "model 'cart' of two-dist is refused: one-dist has that name",
        "the plug-in 'one' of three-dist is refused: one-dist has one of that name",
    ]
    assert found.names("models") == ["bike", "boat", "cart"]
    assert found.offered("models", "cart").distribution == "one-dist"


@pytest.mark.parametrize("raised", ["SystemExit(3)", "ValueError('a defect')", "BaseException('out')"])
def test_what_an_offer_raises_when_it_is_imported_is_one_line(raised: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "breaks_late.py").write_text(f"raise {raised}\n")
    monkeypatch.syspath_prepend(str(tmp_path))
    found = Registry()
    found.add("late", "late-dist", "1", module(s2r_models=[Offer("cart", "breaks_late:MODEL")]))
    with pytest.raises(PluginError, match="model 'cart' of late-dist cannot be loaded: "):
        found.get("models", "cart")


def test_ctrl_c_is_the_users() -> None:
    with pytest.raises(KeyboardInterrupt):
        Registry().add("odd", "odd-dist", "1", module(s2r_models=KeyboardInterrupt()))


# ---------------------------------------------------------------- installed


BROKEN = {
    "exits": "raise SystemExit('I am a script')",
    "raises": "raise RuntimeError('no such\\nbus')",
    "missing": "import a_library_that_nobody_has",
    "unknown": "from s2r_runtime.hookspecs import hookimpl\n@hookimpl\ndef s2r_teapots():\n    return []",
    "nonsense": "def no Python",
    "copies": (
        "from s2r_runtime.hookspecs import Offer, hookimpl\n"
        "@hookimpl\ndef s2r_models():\n    return [Offer('unicycle', 'json:loads'), Offer('mine', 'json:loads')]"
    ),
    "bare": (
        "from s2r_runtime.hookspecs import Offer, hookimpl\n"
        "@hookimpl\ndef s2r_transports():\n    return [Offer('bare', 'bare.plugin:Bare')]\n"
        "class Bare:\n    OPTIONS = {}\n    def __init__(self, options, states, inputs): pass"
    ),
    "halves": (
        "from s2r_runtime.hookspecs import Offer, hookimpl\n"
        "@hookimpl\ndef s2r_models():\n    return [Offer('half', 'halves.plugin:NOWHERE')]\n"
        "@hookimpl\ndef s2r_effects():\n    return [Offer('other_half', 'no_such_package:EFFECT')]"
    ),
    "dies": (
        "from s2r_runtime.hookspecs import Offer, hookimpl\nimport os\n"
        "@hookimpl\ndef s2r_models():\n    return [Offer('dies', 'dies.plugin:MODEL')]\n"
        "class Model:\n    name, states, inputs, angles, parameters = 'dies', ('x',), ('u',), (), {}\n"
        "    def step(self, x, u, dt, p): os._exit(9)\nMODEL = Model()"
    ),
}


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder on the path with broken plug-ins, as an installer leaves them."""
    place = tmp_path_factory.mktemp("site")
    for name, body in BROKEN.items():
        (place / name).mkdir()
        (place / name / "__init__.py").touch()
        (place / name / "plugin.py").write_text(body + "\n")
        info = place / f"{name}_dist-0.3.dist-info"
        info.mkdir()
        (info / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {name}-dist\nVersion: 0.3\n")
        (info / "entry_points.txt").write_text(f"[s2r_runtime]\n{name} = {name}.plugin\n")
    return place


def s2r(site: Path, *words: str) -> subprocess.CompletedProcess[str]:
    environment = {**os.environ, "PYTHONPATH": f"{site}{os.pathsep}{ROOT}", "NO_COLOR": "1", "XDG_STATE_HOME": str(site / "home")}
    environment["XDG_RUNTIME_DIR"] = str(site)
    argv = [sys.executable, "-m", "s2r_runtime.cli.main", *words]
    return subprocess.run(argv, env=environment, capture_output=True, text=True, timeout=100, check=False)


@pytest.mark.slow
def test_list_says_what_is_wrong_with_each_and_the_others_are_in_use(site: Path) -> None:
    done = s2r(site, "plugin", "list", "--json")
    assert done.returncode == 1
    found = {p["name"]: p for p in json.loads(done.stdout)["plugins"]}
    assert found["exits"]["error"] == "SystemExit: I am a script"
    assert found["raises"]["error"] == "RuntimeError: no such bus"
    assert found["missing"]["error"] == "ModuleNotFoundError: No module named 'a_library_that_nobody_has'"
    assert "s2r_teapots" in found["unknown"]["error"]
    assert found["nonsense"]["error"].startswith("SyntaxError: ")
    assert found["copies"]["error"] == "model 'unicycle' of copies-dist is refused: s2r-runtime has that name"
    assert found["copies"]["offers"] == {"models": ["mine"]}
    assert {(found[name]["distribution"], found[name]["version"]) for name in BROKEN} == {(f"{name}-dist", "0.3") for name in BROKEN}
    assert found["exits"]["origin"].startswith(str(site))
    assert found["builtin"]["error"] == found["zenoh"]["error"] == ""


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "code", "words"),
    [
        ("nobody", 78, "no plug-in 'nobody' is installed; there are: builtin"),
        ("zenho", 78, "did you mean 'zenoh'?"),
        ("exits", 78, "plug-in 'exits' of exits-dist is not in use: SystemExit: I am a script"),
        ("bare", 1, "no kit is offered for it, so nothing was checked"),
        ("halves", 1, "model 'half' of halves-dist cannot be loaded: AttributeError: module 'halves.plugin' has no attribute 'NOWHERE'"),
        ("halves", 1, "effect 'other_half' of halves-dist cannot be loaded: ModuleNotFoundError: No module named 'no_such_package'"),
        ("dies", 1, "the kits did not come to an end (models dies: "),
    ],
)
def test_check_of_what_cannot_pass_says_why(site: Path, name: str, code: int, words: str) -> None:
    done = s2r(site, "plugin", "check", name)
    assert done.returncode == code, done.stdout + done.stderr
    assert words in done.stdout + done.stderr
    assert "keeps its interface" not in done.stdout


@pytest.mark.slow
def test_daemon_says_which_plug_ins_are_broken_and_in_one_line_that_a_transport_is_none(site: Path) -> None:
    text = (ROOT / "profiles" / "robotarium.toml").read_text()
    (site / "p.toml").write_text(text[: text.index("[transport]")] + '[transport]\nname = "bare"\n')
    done = s2r(site, "run", str(site / "p.toml"))
    assert done.returncode == 78
    last = done.stderr.strip().splitlines()[-1]
    assert "s2r: plug-in 'exits' of exits-dist not in use: SystemExit: I am a script" in done.stderr
    assert "s2r: plug-in 'copies' of copies-dist in part not in use: model 'unicycle' of copies-dist is refused" in done.stderr
    methods = "open, fileno, receive, decode, poll, encode, send, counters, close"
    assert last == f"s2r: transport 'bare' of bare-dist lacks {methods}: see Transport in s2r_runtime/hookspecs.py"
