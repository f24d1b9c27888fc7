"""DBC files of others: what is odd in one is said on one line where it matters, and doesn't matter elsewhere."""

from __future__ import annotations

import math
import shutil
from importlib import metadata
from pathlib import Path
from typing import Any

import can
import pytest
from crccheck.crc import Crc8SaeJ1850
from s2r_can import checksums
from s2r_can.base import Base, Sheet
from s2r_can.checksums import Covered, crc8_j1850, guarded, scheme_of, sum8, xor8
from s2r_can.database import Database
from s2r_can.options import Source
from s2r_can.records import records
from s2r_can.testing import CLASSIC, INPUTS, STATES, options_of
from s2r_can.transport import CanTransport
from s2r_can.units import factor_of

from s2r_runtime.errors import ConfigError
from s2r_runtime.messages import Command
from s2r_runtime.models.composed import compose
from s2r_runtime.modelspec import EffectSpec, ModelSpec
from s2r_runtime.profile import load_profile, parse_profile

ROOT = Path(__file__).parents[3]
HEAD = 'VERSION ""\n\nNS_ :\n\nBS_:\n\nBU_: A B\n\nBO_ 100 M: 8 A\n SG_ S : 0|8@1+ (1,0) [0|0] "°" B\n'


def database(more: str = "", head: str = HEAD) -> Database:
    return Database({"file": "odd.dbc", "text": head + more})


def test_signal_is_found_by_its_own_name_where_only_one_message_has_it() -> None:
    found = database('\nBO_ 101 N: 8 A\n SG_ T : 0|8@1+ (1,0) [0|0] "" B\n SG_ S : 8|8@1+ (1,0) [0|0] "" B\n')
    assert str(found.signal("T", "x")) == "N.T"
    with pytest.raises(ConfigError, match=r"2 messages of odd\.dbc have a signal 'S': say which: M\.S, N\.S"):
        found.signal("S", "x")
    assert str(found.signal("M.S", "x")) == "M.S"


@pytest.mark.parametrize(
    ("more", "says"),
    [
        ('\nBO_ 101 M: 8 A\n SG_ T : 0|8@1+ (1,0) [0|0] "" B\n', "has several messages 'M'"),
        ('\nBO_ 100 N: 8 A\n SG_ T : 0|8@1+ (1,0) [0|0] "" B\n', "gives one identifier to M and N"),
    ],
)
def test_message_that_is_there_twice_is_refused_if_it_is_used(more: str, says: str, capfd: pytest.CaptureFixture[str]) -> None:
    found = database(more + '\nBO_ 105 Other: 8 A\n SG_ Q : 0|8@1+ (1,0) [0|0] "" B\n')
    with pytest.raises(ConfigError, match=says):
        found.message("M", "x")
    assert str(found.signal("Other.Q", "x")) == "Other.Q"
    assert capfd.readouterr().err == "", "cantools says nothing behind our back"


def test_file_with_carriage_returns_and_old_code_pages_is_read(tmp_path: Path) -> None:
    path = tmp_path / "old.dbc"
    path.write_bytes(HEAD.replace("\n", "\r\n").encode("cp1252"))
    assert Database(str(path)).signal("M.S", "x").signal.unit == "°"


@pytest.mark.parametrize(
    ("unit", "factor"),
    [
        ("", 1.0), ("m/s", 1.0), ("km/h", 1 / 3.6), ("deg", math.pi / 180), ("°/s", math.pi / 180), ("rpm", math.pi / 30),
        ("1/min", math.pi / 30), ("mm", 1e-3), ("m/s²", 1.0), (" Rad ", 1.0), ("%", 0.01), ("furlong", None), ("mA", None),
    ],
)  # fmt: skip
def test_unit_is_taken_to_si_or_not_guessed(unit: str, factor: float | None) -> None:
    assert factor_of(unit) == (pytest.approx(factor) if factor is not None else None)


def test_profile_scale_and_offset_replace_the_dbcs_unit() -> None:
    from s2r_can.layout import scaled

    found = scaled(database().signal("M.S", "x"), Source("M.S", 0.5, -1.0), "x")
    assert (found.factor, found.shift_si) == (0.5, -1.0)
    assert scaled(database().signal("M.S", "x"), Source("M.S"), "x").factor == pytest.approx(math.pi / 180)


# ---------------------------------------------------------------- checksums


def test_crc_is_the_one_that_it_is_called() -> None:
    assert crc8_j1850(Covered(b"123456789", b"", 0, -1)) == 0x4B
    for data in (b"", b"\0", b"\xff" * 63, bytes(range(64))):
        assert crc8_j1850(Covered(data, b"", 0, -1)) == Crc8SaeJ1850.calc(data)
    assert xor8(Covered(b"\x0f\xf0\x01", b"", 0, -1)) == 0xFE
    assert sum8(Covered(b"\xff\x02", b"", 0, -1)) == 1


def test_checksum_covers_the_data_id_and_everything_but_itself() -> None:
    payload = bytes(range(1, 9))
    whole = guarded(crc8_j1850, 0xFF << 8, 8, 0x100, 0x1234)
    assert whole.expected(payload) == Crc8SaeJ1850.calc(b"\x34\x12" + payload[:1] + payload[2:])
    assert whole.expected(payload[:1] + b"\xee" + payload[2:]) == whole.expected(payload)
    part = guarded(crc8_j1850, 0xF << 4, 4, 0x100, -1)
    zeroed = bytes([payload[0] & 0x0F]) + payload[1:]
    assert part.expected(payload) == Crc8SaeJ1850.calc(zeroed) & 0xF


def test_another_scheme_comes_from_an_installed_package(monkeypatch: pytest.MonkeyPatch) -> None:
    point = metadata.EntryPoint("inverted", f"{__name__}:unused", checksums.GROUP)
    monkeypatch.setattr(metadata.EntryPoint, "load", lambda self: lambda covered: sum8(covered) ^ 0xFF)
    monkeypatch.setattr(metadata, "entry_points", lambda group: [point] if group == checksums.GROUP else [])
    assert scheme_of("inverted", "x")(Covered(b"\x01", b"", 0, -1)) == 0xFE
    with pytest.raises(ConfigError, match="did you mean 'inverted'"):
        scheme_of("invertd", "x")


def test_command_says_what_the_dbc_starts_a_signal_with_unless_the_profile_says_otherwise() -> None:
    text = CLASSIC.replace("Enable : 52|1", 'Mode : 40|8@1+ (1,-10) [-10|100] "" Base\n SG_ Enable : 52|1').replace("31|24@0-", "31|16@0-")
    text += 'BA_DEF_ SG_ "GenSigStartValue" INT 0 255;\nBA_DEF_DEF_ "GenSigStartValue" 0;\nBA_ "GenSigStartValue" SG_ 528 Mode 7;\n'

    def mode(**more: Any) -> int:
        options = {**options_of(text, {"interface": "virtual"}), **more}
        transport = CanTransport(options, STATES, INPUTS)
        (record,) = records(transport.encode(Command(1, 0, "sampler", (0.0, 0.0), 0, 1)).data)
        return record.payload[5]

    assert mode() == 7
    assert mode(constants={"Drive.Mode": 20, "Drive.Enable": 1}) == 30


# ---------------------------------------------------------------- the profile and the stand-in


def test_dbc_is_part_of_the_profile_and_found_beside_it(tmp_path: Path) -> None:
    for name in ("amr-can.toml", "amr-can.dbc"):
        shutil.copy(ROOT / "profiles" / name, tmp_path)
    path = tmp_path / "amr-can.toml"
    before = load_profile(path)
    assert before.files == {"amr-can.dbc": (ROOT / "profiles" / "amr-can.dbc").read_text()}
    text = (tmp_path / "amr-can.dbc").read_text()
    (tmp_path / "amr-can.dbc").write_text(text.replace("(0.0001,0) [-50|50]", "(0.0002,0) [-50|50]"))
    assert load_profile(path).digest() != before.digest(), "another scale is another robot: no certificate covers it"
    assert parse_profile(path.read_text(), "log", Path(), {"amr-can.dbc": text}).digest() == before.digest()
    with pytest.raises(ConfigError, match=r"transport\.dbc: amr-can\.dbc is not attached"):
        parse_profile(path.read_text(), "log", Path(), {})
    (tmp_path / "amr-can.dbc").unlink()
    with pytest.raises(ConfigError, match=r"transport\.dbc: .*amr-can\.dbc: cannot be read: No such file"):
        load_profile(path)


def test_the_profiles_advice_for_a_bus_without_a_pose_works(tmp_path: Path) -> None:
    text = (ROOT / "profiles" / "amr-can.toml").read_text()
    for line in ('x = "Position.X"\n', 'y = "Position.Y"\n'):
        text = text.replace(line, "")
    lines = [line for line in text.splitlines() if not line.startswith(("theta = ", "stamp = "))]
    reckoning = next(k for k, line in enumerate(lines) if line == "# [transport.dead_reckoning]")
    for k in range(reckoning, reckoning + 5):
        lines[k] = lines[k].removeprefix("# ")
    text = "\n".join(lines).replace('trigger = "Heading"', 'trigger = "WheelSpeeds"')
    (tmp_path / "amr-can.dbc").write_bytes((ROOT / "profiles" / "amr-can.dbc").read_bytes())
    profile = parse_profile(text, "advised", tmp_path)
    states = ("x", "y", "theta", "wheel_left", "wheel_right")
    transport = {k: v for k, v in profile.transport.items() if k != "name"}
    CanTransport(transport, states, ("cmd_left", "cmd_right"))
    assert transport.keys() >= {"dead_reckoning"}
    assert transport["states"].keys() == {"wheel_left", "wheel_right"}


def test_stand_in_and_profile_have_the_same_dbc() -> None:
    from s2r_can.standin import DBC

    assert DBC.read_bytes() == (ROOT / "profiles" / "amr-can.dbc").read_bytes()


def test_stand_in_moves_as_its_data_sheet_says_and_the_profiles_model_agrees() -> None:
    """Two pieces of arithmetic that share nothing."""
    import numpy as np

    profile = load_profile(ROOT / "profiles" / "amr-can.toml")
    model = compose(profile.model)
    base = Base(Sheet(sigma_position=0.0, sigma_heading=0.0, sigma_wheel=0.0), (0.0, 0.0, 0.0), 1)
    x, hidden = np.zeros((1, 5)), model.at_rest(1)
    for k in range(100):
        u = (6.0 * math.sin(0.05 * k), 5.0 * math.cos(0.03 * k))
        base.move(u)
        x, hidden = model.step(x, np.array([u]), hidden)
    m = base.observe()
    # the model takes the mean over the last fifth of a step for its end: a tenth of a step of 20 ms late, at up to 0.3 rad/s a step
    assert (m.left, m.right) == pytest.approx(tuple(x[0, 3:]), abs=0.3 * 0.1)
    assert (m.x, m.y, m.theta) == pytest.approx(tuple(x[0, :3]), abs=1e-3)


@pytest.mark.parametrize(
    "spec", [EffectSpec("input_gain", "cmd_left", {"gain": 0.5}), EffectSpec("input_bias", "cmd_right", {"bias": 0.4})]
)
def test_undeclared_effect_changes_what_the_stand_in_does(spec: EffectSpec) -> None:
    import numpy as np

    base = Base(Sheet(time_constant=0.0, latency=0, sigma_wheel=0.0), (0.0, 0.0, 0.0), 1)
    base.switch_on(f"{spec.name}:{spec.channel} " + " ".join(f"{k}={v}" for k, v in spec.parameters.items()))
    base.move((2.0, 3.0))
    model = compose(ModelSpec("differential_drive", 0.02, effects=(spec,)))
    acting, _, _ = model.act(np.array([[2.0, 3.0]]), model.at_rest(1))
    assert base.wheels == pytest.approx(tuple(acting[0]))
    base.clear()
    base.move((2.0, 3.0))
    assert base.wheels == pytest.approx((2.0, 3.0))
    with pytest.raises(ConfigError, match="unknown effect 'nonsense'"):
        base.switch_on("nonsense")


def test_bus_at_full_load_hides_no_observation() -> None:
    """8000 frames a second of other nodes' traffic: what 1 Mbit/s can carry."""
    import threading
    import time

    from s2r_can.testing import VirtualRig

    from s2r_runtime.testing.transport_kit import Line

    with VirtualRig() as rig:
        rig.transport.open()
        line, over = Line(rig), threading.Event()
        first = line.link((0.0, 0.0, 0.0))
        sent = 0

        def flood() -> None:
            nonlocal sent
            with can.Bus(ignore_config=True, **rig.options["robot"]) as other:
                while not over.wait(0.01):
                    for _ in range(80):
                        other.send(can.Message(arbitration_id=sent % 0x700, data=bytes(8), is_extended_id=False))
                        sent += 1

        thread = threading.Thread(target=flood)
        thread.start()
        try:
            for k in range(1, 151):
                rig.robot.publish(first + k, (first + k) * 10_000_000, (0.0, 0.0, 0.0))
                line.turn()
                time.sleep(0.005)
            assert line.until(lambda: line.reached(first + 150))
        finally:
            over.set()
            thread.join()
        counters = line.transport.counters()
        assert sent > 3000
        assert counters["foreign"] == sent
        assert (counters["lost"], counters["dropped_in"], counters["malformed"]) == (0, 0, 0)
