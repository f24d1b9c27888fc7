"""Only what a DBC states of the messages that a profile names decides: whether the file can be used, and which robot it is."""

from __future__ import annotations

import importlib.util
import random
from pathlib import Path
from typing import Any

import cantools
import pytest
from s2r_can.database import Database
from s2r_can.dbc import Outline
from s2r_can.transport import CanTransport

from s2r_runtime.errors import ConfigError
from s2r_runtime.profile import parse_profile

SPEC = importlib.util.spec_from_file_location("random_dbc", Path(__file__).with_name("random_dbc.py"))
assert SPEC is not None
assert SPEC.loader is not None
random_dbc = importlib.util.module_from_spec(SPEC)
SPEC.loader.exec_module(random_dbc)

READ = """VERSION ""
BU_: A B
BO_ 257 State: 8 A
 SG_ Pos : 0|32@1- (0.0001,0) [-1000|1000] "m" B
 SG_ Vel : 32|32@1- (0.0001,0) [-1000|1000] "m/s" B
BO_ 513 Cmd: 8 B
 SG_ Force : 0|16@1- (0.001,0) [-30|30] "N" A
"""
UNREAD = """BO_ 300 Door: 8 A
 SG_ Open : 0|1@1+ (1,0) [0|1] "" B
 SG_ Mode M : 1|2@1+ (1,0) [0|3] "" B
 SG_ Angle m1 : 8|16@1- (0.1,0) [-180|180] "deg" B
"""
TAIL = """CM_ BO_ 257 "where it is;
BO_ 257 is no message here";
BA_DEF_ BO_ "GenMsgCycleTime" INT 0 65535;
BA_DEF_ SG_ "Anything" ENUM "a","b";
BA_DEF_DEF_ "GenMsgCycleTime" 100;
BA_DEF_DEF_ "Anything" "a";
BA_ "GenMsgCycleTime" BO_ 257 20;
VAL_ 257 Vel 2147483647 "invalid" ;
"""
UNREAD_TAIL = """CM_ SG_ 300 Open "whether it is open";
BA_ "Anything" SG_ 300 Open 1;
BA_ "GenMsgCycleTime" BO_ 300 7;
VAL_ 300 Open 0 "shut" 1 "open" ;
SIG_VALTYPE_ 300 Angle : 0;
SG_MUL_VAL_ 300 Angle Mode 1-1;
"""
PROFILE = """
[robot]
name = "joint-robot"
[region]
q = [-100.0, 100.0]
qd = [-30.0, 30.0]
[inputs]
force = [-2.0, 2.0]
[task]
name = "stl"
[task.parameters]
horizon = 1.0
metric = "always (qd < 40)"
progress = "none"
[task.parameters.start]
q = [0.0, 1.0]
[model]
name = "joint"
dt = 0.02
[transport]
name = "can"
dbc = "joint.dbc"
trigger = "State"
[transport.robot]
interface = "virtual"
channel = "can0"
[transport.states]
q = "State.Pos"
qd = "State.Vel"
[transport.inputs]
force = "Cmd.Force"
"""
WHOLE = READ + UNREAD + TAIL + UNREAD_TAIL


def digest_of(text: str) -> str:
    return parse_profile(PROFILE, "p", Path(), {"joint.dbc": text}).digest()


def transport_of(text: str, **more: Any) -> CanTransport:
    options = {**parse_profile(PROFILE, "p", Path(), {"joint.dbc": text}).transport, **more}
    return CanTransport({name: value for name, value in options.items() if name != "name"}, ("q", "qd"), ("force",))


@pytest.mark.parametrize(
    "line",
    [
        'BO_ 271581185 NotRead: 8 A\n SG_ Door : 0|1@1+ (1,0) [0|1] "" B\n',
        'BO_ 301 2017_5: 8 A\n SG_ 0_COUNTER : 0|4@1+ (1,0) [0|15] "" B\n',
        'VAL_ 257 NoSuchSignal 1 "on" 0 "off" ;\n',
        'VAL_ 999 Gone 1 "on" ;\nBA_ "GenMsgCycleTime" BO_ 999 5;\nSIG_VALTYPE_ 999 Gone : 1;\n',
        'BO_ 302 Bad: 8 A\n SG_ Broken 0|1@1+ (1,0) [0|1] "" B\n',
        'BOx_ 302 Bad: 8 A\n SG_ Orphan : 0|1@1+ (1,0) [0|1] "" B\n',
        'BO_ x302 Worse: 8 A\n SG_ Orphan : 0|1@1+ (1,0) [0|1] "" B\n',
        'CM_ BO_ 300 "never closed ;\n',
        'BA_ "Unknown" BO_ 257 "x;\n',
        'VAL_ 300 Open 1 "on 0 "off";\n',
        "FOO_ bar;\n%&\n",
    ],
)
def test_line_about_what_is_never_read_refuses_nothing(line: str) -> None:
    """Each of the first five is refused by cantools 45."""
    clean = digest_of(WHOLE)
    for text in (READ + line + TAIL, READ + TAIL + line, line + READ + TAIL):
        transport_of(text)
        assert digest_of(text) == clean, "and it is the same robot"


@pytest.mark.parametrize(
    ("old", "new", "wrong"),
    [
        ('[-1000|1000] "m" B', '[-1000|] "m" B', "message State: line 4 cannot be read: 'SG_ Pos"),
        ('VAL_ 257 Vel 2147483647 "invalid" ;', 'VAL_ 257 Vel 2147483647 "invalid ;', "message State: line .* cannot be read: 'VAL_ 257"),
        ("BO_ 257 20;", "BO_ 257 20", 'message State: line .* cannot be read: \'BA_ "GenMsgCycleTime"'),
        (" SG_ Vel", " FOO\n SG_ Vel", "message State: line 6 comes behind what is no statement: 'Vel'"),
        ("BO_ 300 Door", "BO_ 257 Door", "gives one identifier to State and Door"),
        ("BO_ 257 State: 8", "BO_ 257 State 8", "has no signal 'State.Pos'"),
    ],
)
def test_line_about_what_is_read_must_be_right(old: str, new: str, wrong: str) -> None:
    assert old in WHOLE
    with pytest.raises(ConfigError, match=wrong):
        transport_of(WHOLE.replace(old, new))


def test_identifier_of_29_bits_without_bit_31_and_names_with_digits_can_be_read() -> None:
    text = WHOLE.replace("257", "271581185").replace("State", "2017_5").replace("Pos", "0_POS")
    transport = transport_of(text, trigger="2017_5", states={"q": "2017_5.0_POS", "qd": "2017_5.Vel"})
    layout = transport._layout
    assert [hex(key) for key in layout.inbound] == ["0x90300001".replace("90300001", f"{271581185 | 1 << 31:x}")]
    assert [s.bits.name for group in layout.groups for s in group.signals] == ["2017_5.0_POS", "2017_5.Vel"]


@pytest.mark.slow
def test_fuzzed_text_about_unread_messages_changes_nothing() -> None:
    """Any byte of what is never read may be any other, as long as it does not come to be about a message that is read."""
    clean, draw, tried = digest_of(WHOLE), random.Random(7), 0
    for _ in range(400):
        parts = []
        for part in (UNREAD, UNREAD_TAIL):
            letters = list(part)
            for _ in range(draw.randrange(1, 6)):
                kind, at = draw.randrange(4), draw.randrange(len(letters))
                if kind == 0:
                    letters[at] = chr(draw.randrange(32, 256))
                elif kind == 1:
                    del letters[at : at + draw.randrange(1, 20)]
                elif kind == 2:
                    letters.insert(at, draw.choice(['"', ";", "\n", "\\", "|", "BO_ ", "SG_ ", "\0", "VAL_ "]))
                else:
                    letters = letters[:at] + letters
            parts.append("".join(letters))
        text = READ + "BS_:\n" + parts[0] + "\n" + TAIL + parts[1]  # signals behind a line that is nothing may be anybody's
        if any(number in "".join(parts) for number in ("257", "513")):
            continue
        tried += 1
        transport_of(text)
        assert digest_of(text) == clean
    assert tried > 350


@pytest.mark.parametrize("seed", range(25))
def test_normal_form_means_to_cantools_what_the_whole_file_means(seed: int) -> None:
    text = random_dbc.Dbc(seed).text
    whole: Any = cantools.database.load_string(text, database_format="dbc", strict=False)
    names = {message.name for message in whole.messages}
    cut: Any = cantools.database.load_string(Outline(text).cut(names, set()).text, database_format="dbc", strict=False)
    assert {m.name for m in cut.messages} == names
    for message in whole.messages:
        same = cut.get_message_by_name(message.name)
        facts = ("frame_id", "is_extended_frame", "length", "cycle_time", "is_fd")
        assert [getattr(same, fact) for fact in facts] == [getattr(message, fact) for fact in facts]
        assert {s.name for s in same.signals} == {s.name for s in message.signals}
        for signal in message.signals:
            other = same.get_signal_by_name(signal.name)
            facts = ("start", "length", "byte_order", "is_signed", "is_float", "scale", "offset", "minimum", "maximum", "unit", "choices")
            facts += ("raw_initial", "multiplexer_ids", "multiplexer_signal", "is_multiplexer")
            assert [getattr(other, fact) for fact in facts] == [getattr(signal, fact) for fact in facts], signal.name
    again = Outline(Outline(text).cut(names, set()).text).cut(names, set()).text
    assert again == Outline(text).cut(names, set()).text, "the normal form is its own"


def test_digest_is_of_what_the_messages_mean_and_not_of_how_it_is_written() -> None:
    clean = digest_of(WHOLE)
    assert digest_of(WHOLE.replace("\n", "\r\n").replace("0.0001", "1E-4").replace(" : ", "  :  ")) == clean
    assert digest_of(WHOLE.replace("where it is", "somewhere")) == clean
    for old, new in (("0.0001", "0.0002"), ("257 20", "257 30"), ('"invalid"', '"good"'), ("513", "514"), ("[-30|30]", "[-20|30]")):
        assert digest_of(WHOLE.replace(old, new)) != clean, old


def test_database_without_a_profile_has_all_messages() -> None:
    database = Database({"file": "a.dbc", "text": WHOLE})
    assert str(database.signal("Angle", "x")) == "Door.Angle"
