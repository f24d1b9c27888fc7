"""A profile that cannot be used is refused where it is read, in one line: never "valid" first and an internal error later."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import msgspec
import pytest

from s2r_runtime.errors import ConfigError
from s2r_runtime.profile import Profile, load_profile, parse_profile

PROFILES = Path(__file__).parent.parent / "profiles"
ROBOTARIUM = (PROFILES / "robotarium.toml").read_text(encoding="utf-8")


def with_setting(table: str, key: str, value: str) -> Profile:
    """The Robotarium's profile with one setting more, or with another value of it."""
    head, header, rest = ROBOTARIUM.partition(f"[{table}]")
    body, following, tail = rest.partition("\n[")
    kept = "\n".join(line for line in body.splitlines() if not line.startswith(f"{key} = "))
    return parse_profile(f"{head}{header or f'[{table}]'}{kept}\n{key} = {value}\n{following}{tail}", "p.toml", PROFILES)


def numbers() -> Iterator[tuple[str, str]]:
    """(table, key) of every setting that is one number with a fraction."""
    for table in msgspec.structs.fields(Profile):
        if isinstance(table.type, type) and issubclass(table.type, msgspec.Struct):
            yield from ((table.name, field.name) for field in msgspec.structs.fields(table.type) if field.type is float)


@pytest.mark.parametrize("path", sorted(PROFILES.glob("*.toml")), ids=lambda path: path.stem)
def test_every_profile_that_comes_along_is_valid(path: Path) -> None:
    assert load_profile(path).digest().startswith("sha256:")


@pytest.mark.parametrize("value", ["nan", "inf", "-inf"])
@pytest.mark.parametrize(("table", "key"), list(numbers()))
def test_a_number_that_is_not_finite_is_refused_wherever_it_stands(table: str, key: str, value: str) -> None:
    with pytest.raises(ConfigError, match=rf"^p\.toml: {table}\.{key} is {value}"):
        with_setting(table, key, value)


@pytest.mark.parametrize(
    ("table", "key", "told"),
    [
        ("recovery.input", "v", "recovery.input.v is nan"),
        ("recovery.home", "x", "recovery.home.x is nan, must be finite"),
        ("transport", "timeout", "transport.timeout is nan, must be finite"),
        ("task.parameters", "target_radius", "task.parameters.target_radius is nan, must be finite"),
    ],
)
def test_nor_among_what_is_named_by_the_robot_and_its_parts(table: str, key: str, told: str) -> None:
    with pytest.raises(ConfigError, match=told):
        with_setting(table, key, "nan")


@pytest.mark.parametrize(
    ("table", "key", "value", "must"),
    [
        ("model", "dt", "1e-12", "a nanosecond to 1e9 s"),
        ("model", "dt", "1e300", "a nanosecond to 1e9 s"),
        ("sampling", "waypoint_margin", "-0.1", ">= 0 m"),
        ("sampling", "max_rejections", "-1", ">= 0"),
        ("sampling", "seed", "-1", ">= 0"),
        ("verification", "timeout", "0.0", "> 0 s"),
        ("gate", "observation_timeout", "1e300", "at most 1e9 s"),
        ("gate", "command_ttl", "1e300", "at most 1e9 s"),
        ("gate", "hysteresis", "1e300", "at most 1e9 s"),
        ("gate", "settle_periods", "-1", ">= 0"),
        ("watch", "max_faults", "-1", ">= 0"),
        ("recording", "rotate_bytes", "-1", ">= 0"),
        ("recording", "rotate_after", "-1.0", ">= 0"),
        ("certificate", "lifetime", "1e300", "at most 1e9 s"),
        ("repair", "delay", "1e300", "at most 1e9 s"),
    ],
)
def test_a_setting_that_means_nothing_is_refused(table: str, key: str, value: str, must: str) -> None:
    with pytest.raises(ConfigError, match=rf"^p\.toml: {table}\.{key} is .*, must be .*{must}"):
        with_setting(table, key, value)


def test_a_home_beyond_the_fence_is_refused() -> None:
    """The gate is closed on the way there: nothing else would stop the robot."""
    assert with_setting("recovery", "home", '{ x = 0.5 }\nkind = "return"').recovery.home == {"x": 0.5}
    with pytest.raises(ConfigError, match=r"recovery\.home\.x is 9\.0, must be in (region|geofence)\.x: "):
        with_setting("recovery", "home", '{ x = 9.0 }\nkind = "return"')
    assert with_setting("recovery", "home", "{ x = 9.0 }").recovery.kind == "stop", "which never goes there"


def test_a_recovery_command_beyond_the_input_bounds_is_refused() -> None:
    """It would go out clamped: another command than the profile says."""
    assert with_setting("recovery", "input", '{ v = -0.2 }\nkind = "hold"').recovery.input == {"v": -0.2}
    with pytest.raises(ConfigError, match=r"recovery\.input\.v is 5\.0, must be in inputs\.v: -0\.2 to 0\.2"):
        with_setting("recovery", "input", '{ v = 5.0 }\nkind = "hold"')
    assert with_setting("recovery", "input", "{ v = 5.0 }").recovery.kind == "stop", "which never sends it"
