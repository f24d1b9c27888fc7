"""`s2r plugin show`: what it tells is what a model's file may say."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

from s2r_runtime.cli.main import main
from s2r_runtime.errors import ConfigError
from s2r_runtime.hookspecs import Effect
from s2r_runtime.models.composed import compose
from s2r_runtime.modelspec import EffectSpec, ModelSpec
from s2r_runtime.plugins import registry

OWN = """
STATES, INPUTS = ("level",), ("pump",)
PARAMS = {"area": 2.0}
UNITS = {"level": "m", "pump": "m³/s"}
def step(x, u, dt, params):
    return x + dt * u / params["area"]
"""


def told(capsys: pytest.CaptureFixture[str], *argv: str) -> list[dict[str, Any]]:
    assert main(["plugin", "show", *argv, "--json"]) == 0
    found: list[dict[str, Any]] = json.loads(capsys.readouterr().out)["offers"]
    return found


@pytest.mark.parametrize("name", registry().names("effects"))
def test_every_channel_that_is_told_of_an_effect_is_one_and_no_other(name: str, capsys: pytest.CaptureFixture[str]) -> None:
    (shown,) = told(capsys, name)
    effect: Effect = registry().get("effects", name)
    for model in registry().names("models"):
        nominal = compose(ModelSpec(model, 0.1)).for_effects
        here = [one for one in shown["on"] if one["model"] == model]
        assert sorted(channel for one in here for channel in one["channels"]) == sorted(effect.channels(nominal))
        for one in here:
            for channel in one["channels"]:
                assert one["units"] == {p: effect.unit(nominal, channel, p) for p in one["units"]}
                with pytest.raises(ConfigError, match=r"must be in|must be one of|rows of"):  # a value beyond the bounds that are told
                    compose(ModelSpec(model, 0.1, {}, (EffectSpec(name, channel, {p["name"]: _beyond(p) for p in shown["parameters"]}),)))


def _beyond(p: dict[str, Any]) -> Any:
    if "words" in p:
        return "no such word"
    return [[2.0 * p["high"]] * p["shape"][1]] * p["shape"][0] if p["shape"] else 2.0 * p["high"] + 1.0


@pytest.mark.parametrize("name", registry().names("models"))
def test_a_model_is_told_with_the_numbers_that_it_has_if_nobody_says(name: str, capsys: pytest.CaptureFixture[str]) -> None:
    (shown,) = told(capsys, name)
    model = registry().get("models", name)
    assert [one["name"] for one in shown["states"]] == list(model.states)
    assert [one["unit"] for one in shown["inputs"]] == [model.units[one] for one in model.inputs]
    assert {one["name"]: one["value"] for one in shown["parameters"]} == model.parameters
    here = {(one["name"], channel) for one in shown["effects"] for channel in one["channels"]}
    bound = compose(ModelSpec(name, 0.1)).for_effects
    assert here == {(one, c) for one in registry().names("effects") for c in registry().get("effects", one).channels(bound)}


def test_a_model_of_ones_own_is_told_too(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "tank.py"
    path.write_text(OWN)
    (shown,) = told(capsys, str(path))
    assert shown["states"] == [{"name": "level", "unit": "m"}]
    assert shown["parameters"] == [{"name": "area", "value": 2.0}]
    (lag,) = told(capsys, "input_rate_limit", "--model", str(path))
    assert lag["on"] == [{"model": str(path), "channels": ["pump"], "units": {"rate": "m³/s²", "rate_down": "m³/s²"}}]


def test_people_read_it_in_lines(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["plugin", "show", "viscous_friction", "--model", "joint"]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert lines[0] == "effect viscous_friction: friction in proportion to speed"
    assert lines[-1] == "      joint  qd  coefficient (N s/m), coefficient_positive (N s/m), coefficient_negative (N s/m)"
    assert main(["plugin", "show", "keep_out"]) == 0
    assert "disc_radius" in capsys.readouterr().out
    assert main(["plugin", "show", "zenoh"]) == 0
    assert "robot_listen" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("argv", "code", "words"),
    [
        (["stribek"], 78, "did you mean 'stribeck_friction'?"),
        (["qqqqqq"], 78, "s2r plugin list says what is"),
        (["lateral_slip", "--model", "joint"], 78, "acts on nothing that the model joint has"),
        (["bicycle", "--model", "joint"], 2, "bicycle is offered as model"),
        (["none.py"], 78, "cannot be read"),
        (["none.toml", "--model", "joint"], 2, "is a model"),
    ],
)
def test_what_it_cannot_tell_is_one_line(argv: list[str], code: int, words: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["plugin", "show", *argv]) == code
    shown = capsys.readouterr()
    assert words in shown.err
    assert len(shown.err.splitlines()) == 1
    assert not shown.out


def test_what_one_effect_or_model_raises_is_told_and_not_the_end(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def broken(*_: object) -> tuple[str, ...]:
        raise RuntimeError("no channels today")

    monkeypatch.setattr(registry().get("effects", "input_lag"), "channels", broken, raising=False)
    assert main(["plugin", "show", "joint"]) == 0
    shown = capsys.readouterr()
    assert "input_delay" in shown.out
    assert "input_lag" not in shown.out
    assert shown.err == "s2r: effect 'input_lag' is left out on joint: RuntimeError: no channels today\n"
    monkeypatch.setattr(registry().get("models", "unicycle"), "parameters", None)
    assert main(["plugin", "show", "input_delay"]) == 0
    shown = capsys.readouterr()
    assert "bicycle" in shown.out
    assert "s2r: model 'unicycle' is left out: " in shown.err
