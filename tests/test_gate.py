"""The gate: one situation in which a command passes, and everything that is enough to refuse it."""

from __future__ import annotations

import itertools
import math
import re
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import msgspec
import pytest
from gate_law import CERTIFICATE, COMMAND, MAX, NOW, OPEN, SETTINGS, S
from hypothesis import given, settings
from hypothesis import strategies as st

from s2r_runtime import gate
from s2r_runtime.messages import Observation


@dataclass
class Case:
    """What differs from the open situation, and the reason it must give."""

    reason: str
    situation: dict[str, Any] = field(default_factory=dict)
    command: dict[str, Any] = field(default_factory=dict)
    settings: dict[str, Any] = field(default_factory=dict)
    certificate: dict[str, Any] = field(default_factory=dict)
    now: int = NOW


def at(x: float, y: float, theta: float) -> Observation:
    return Observation(7, 7, (x, y, theta))


BOTH = [
    Case("stopping", {"stopping": True}),
    Case("emergency_stop", {"latched": ("emergency_stop",)}),
    Case("manual_override", {"latched": ("watch_alarm", "manual_override")}),
    Case("robot_twin", {"latched": ("watch_alarm", "robot_twin")}),
    Case("observation_faults", {"latched": ("watch_alarm", "observation_faults")}),
    Case("latched:link_down", {"latched": ("link_down",)}),
    Case("latched:measurement_faults", {"latched": ("measurement_faults",)}),
    Case("clock_backwards", now=NOW - 1),
    Case("recorder_down", {"recorder_ok": False}),
    Case("link_down", {"link_up": False}),
    Case("observation_missing", {"observation": None}),
    Case("observation_invalid", {"trouble": "observation_invalid"}),
    Case("observation_out_of_order", {"trouble": "observation_out_of_order"}),
    Case("observation_invalid", {"observation": Observation(7, 7, (), "not finite")}),
    Case("observation_invalid", {"observation": Observation(7, 7, (0.0, 0.0))}),
    Case("observation_invalid", {"observation": at(math.nan, 0.0, 0.0)}),
    Case("observation_invalid", {"observation": at(0.0, math.inf, 0.0)}),
    Case("observation_stale", {"observation_ns": NOW - S // 5 - 1}),
    Case("observation_stale", {"observation_ns": NOW + 1}),
    Case("command_invalid", command={"fault": "raised"}),
    Case("command_invalid", command={"u": ()}),
    Case("command_invalid", command={"u": (0.1,)}),
    Case("command_invalid", command={"u": (0.1, 0.1, 0.1)}),
    Case("command_invalid", command={"u": (math.nan, 0.0)}),
    Case("command_invalid", command={"u": (0.0, -math.inf)}),
    Case("command_invalid", command={"u": (10**400, 0.0)}),
    Case("command_invalid", command={"u": ("0.1", 0.0)}),
    Case("command_out_of_order", {"asked_seq": None}),
    Case("command_out_of_order", command={"obs_seq": 6}),
    Case("command_out_of_order", command={"obs_seq": 8}),
    Case("command_out_of_order", command={"seq": 3}),
    Case("command_out_of_order", command={"seq": 2}),
    Case("command_stale", command={"t_ns": NOW - S // 10 - 1}),
    Case("command_stale", command={"t_ns": NOW + 1}),
    Case("command_stale", command={"ttl_ns": -1}),
    Case("command_stale", command={"ttl_ns": 10, "t_ns": NOW - 11}),
    Case("command_stale", {"asked_ns": NOW - S // 10 - 1}),
    Case("input_out_of_bounds", command={"u": (0.2000001, 0.0)}),
    Case("input_out_of_bounds", command={"u": (0.0, -3.0000001)}),
    Case("input_out_of_bounds", command={"u": (-MAX, 0.0)}),
    Case("input_out_of_bounds", settings={"input_bounds": ((-0.2, 0.2),)}),
    Case("input_out_of_bounds", settings={"input_bounds": ((-0.2, 0.2), (math.nan, 3.0))}),
    Case("input_out_of_bounds", settings={"input_bounds": ((-0.2, 0.2), (-3.0, math.nan))}),
]
CONTROLLER = [
    Case("latched:controller_fault", {"latched": ("controller_fault",)}),
    Case("latched:anything", {"latched": ("anything",)}),
    Case("no_controller", {"controller_digest": None}),
    Case("verification_running", {"controller_digest": None, "verifying": True}),
    Case("analytics_down", {"analytics_up": False}),
    Case("watch_alarm", {"alarmed": True}),
    Case("no_certificate", {"certificate": None}),
    Case("certificate_revoked", {"revoked": True}),
    Case("certificate_revoked", {"revoked": True, "certificate": None}),
    Case("certificate_expired", {"unix_s": 2000}),
    Case("certificate_expired", {"unix_s": 1000 - gate.CLOCK_SKEW_S - 1}),
    Case("digest_mismatch", {"controller_digest": "another"}),
    Case("digest_mismatch", {"controller_digest": ""}, certificate={"controller_digest": ""}),
    Case("digest_mismatch", {"model_digest": "another"}),
    Case("digest_mismatch", settings={"task_digest": "another"}),
    Case("digest_mismatch", settings={"profile_digest": "another"}),
    Case("digest_mismatch", {"epoch": 2}),
    Case("radius_above_verified", {"radius": 0.0150001}),
    Case("radius_above_verified", {"radius": math.inf}),
    Case("radius_above_verified", {"radius": math.nan}),
    Case("radius_above_verified", certificate={"verified_radius": math.nan}),
    Case("radius_above_verified", {"radius": math.inf}, certificate={"verified_radius": math.inf}),
    Case("verification_running", {"verifying": True}),
    Case("measurement_faults", {"faults": 4}),
    Case("outside_region", {"observation": at(1.6000001, 0.0, 0.0)}),
    Case("outside_region", {"observation": at(0.0, -MAX, 0.0)}),
    Case("outside_region", settings={"region": ((-1.6, 1.6), (-1.0, math.nan), (-math.pi, math.pi))}),
    Case("outside_region", settings={"region": ((-1.6, 1.6),)}),
    Case("outside_region", settings={"region": ((-1.6, 1.6), (-1.0, 1.0), (-0.5, 0.5))}),
    Case("outside_region", settings={"region": ((-1.6, 1.6), (-1.0, 1.0), (-0.5, math.nan))}),
    Case("settling", {"clear_since_ns": None}),
    Case("settling", {"clear_since_ns": NOW - S // 10 + 1}),
    Case("settling", {"clear_since_ns": NOW + 1}),
]
SAMPLER = [
    Case("no_permit", {"permit_until_ns": None}),
    Case("permit_expired", {"permit_until_ns": NOW}),
    Case("permit_expired", {"permit_until_ns": NOW - 10 * S}),
    Case("campaign_not_running", {"campaign_running": False}),
    Case("outside_geofence", {"observation": at(2.0000001, 0.0, 0.0)}),
    Case("outside_geofence", {"observation": at(0.0, 1.6, 0.0)}),
]


def decide(source: str, case: Case) -> gate.Verdict:
    chosen = msgspec.structs.replace(SETTINGS, **case.settings)
    situation = msgspec.structs.replace(OPEN, **case.situation)
    if case.certificate and situation.certificate is not None:
        situation = msgspec.structs.replace(situation, certificate=msgspec.structs.replace(CERTIFICATE, **case.certificate))
    command = msgspec.structs.replace(COMMAND, **{"source": source, **case.command})
    return gate.decide(chosen, situation, command, case.now)


def name(case: Case) -> str:
    changed = {**case.situation, **case.command, **case.settings, **case.certificate}
    return f"{case.reason}-{'-'.join(f'{key}={value}' for key, value in changed.items())}"[:80]


# ---------------------------------------------------------------- promises


@pytest.mark.parametrize("source", ["controller", "sampler"])
def test_a_command_passes_when_every_condition_holds(source: str) -> None:
    verdict = decide(source, Case(""))
    assert verdict.allow
    assert verdict.reason == "allowed"
    assert verdict.margin == pytest.approx(0.5 if source == "controller" else 1.0)  # |y - bound|


@pytest.mark.parametrize("case", BOTH + CONTROLLER, ids=name)
def test_one_failed_condition_is_enough_to_refuse_a_controller(case: Case) -> None:
    verdict = decide("controller", case)
    assert (verdict.allow, verdict.reason) == (False, case.reason)
    assert math.isfinite(verdict.margin)
    assert verdict.margin < 0.0


@pytest.mark.parametrize("case", BOTH + SAMPLER, ids=name)
def test_one_failed_condition_is_enough_to_refuse_the_sampler(case: Case) -> None:
    verdict = decide("sampler", case)
    assert (verdict.allow, verdict.reason) == (False, case.reason)
    assert math.isfinite(verdict.margin)
    assert verdict.margin < 0.0


@pytest.mark.parametrize("source", ["external", "recovery", "", "CONTROLLER", "controller "])
def test_nobody_else_ever_commands(source: str) -> None:
    assert decide(source, Case("")) == (False, "source_not_allowed", gate.NO_NUMBER)


def test_a_situation_of_which_nothing_was_said_is_this_one() -> None:
    assert msgspec.to_builtins(gate.Situation()) == {
        "clock_ns": 0,
        "unix_s": 0,
        "stopping": False,
        "latched": (),
        "recorder_ok": False,
        "link_up": False,
        "permit_until_ns": None,
        "campaign_running": False,
        "controller_digest": None,
        "analytics_up": False,
        "alarmed": False,
        "verifying": False,
        "certificate": None,
        "revoked": False,
        "model_digest": "",
        "epoch": 0,
        "radius": math.inf,
        "faults": 0,
        "observation": None,
        "observation_ns": 0,
        "trouble": "",
        "asked_seq": None,
        "asked_ns": 0,
        "last_command_seq": -1,
        "clear_since_ns": None,
    }


def test_the_defaults_of_a_situation_are_closed_for_everybody() -> None:
    for source in ("controller", "sampler"):
        assert not gate.decide(SETTINGS, gate.Situation(), msgspec.structs.replace(COMMAND, source=source), NOW).allow


@pytest.mark.parametrize(
    ("case", "source"),
    [
        (Case("", {"latched": ("watch_alarm", "controller_fault", "command_invalid")}), "sampler"),
        (Case("", {"certificate": None, "analytics_up": False, "alarmed": True, "radius": math.inf, "faults": 9}), "sampler"),
        (Case("", {"clear_since_ns": None}), "sampler"),
        (Case("", {"permit_until_ns": None, "campaign_running": False}), "controller"),
        (Case("", {"observation": at(-1.6, 1.0, 0.0)}), "controller"),
        (Case("", {"observation": at(-1.6, 1.0, 1e6)}), "controller"),
        (Case("", command={"u": (-0.2, 3.0)}), "controller"),
        (Case("", command={"u": (0, 0)}), "controller"),
        (Case("", {"radius": 0.015, "faults": 3, "unix_s": 1999}), "controller"),
        (Case("", {"unix_s": 1000 - gate.CLOCK_SKEW_S}), "controller"),
        (Case("", {"observation_ns": NOW - S // 5, "asked_ns": NOW - S // 10, "clear_since_ns": NOW - S // 10}), "controller"),
        (Case("", command={"t_ns": NOW - S // 10, "ttl_ns": 10 * S}), "controller"),
        (Case("", settings={"region": ((-1.6, 1.6), (-1.0, 1.0), (0.0, 2.0 * math.pi))}), "controller"),
        (Case("", settings={"region": ((-1.6, 1.6), (-1.0, 1.0), (2.0 * math.pi, 2.0 * math.pi + 2.0))}), "controller"),
        (Case("", {"clear_since_ns": NOW}, settings={"hysteresis_ns": 0}), "controller"),
    ],
    ids=lambda value: name(value) if isinstance(value, Case) else value,
)
def test_what_stands_at_the_bound_or_is_not_asked_of_a_source_passes(case: Case, source: str) -> None:
    assert decide(source, case).allow


def test_a_robot_without_bounded_states_has_a_margin_of_zero() -> None:
    free = {"states": ("theta",), "region": ((-math.pi, math.pi),)}
    verdict = decide("controller", Case("", {"observation": Observation(7, 7, (1.0,))}, settings=free))
    assert verdict == (True, "allowed", 0.0)


@pytest.mark.parametrize(
    ("source", "case", "margin"),
    [
        ("controller", Case("radius_above_verified", {"radius": 0.018}), -0.003),
        ("controller", Case("outside_region", {"observation": at(1.85, 0.0, 0.0)}), -0.25),
        ("controller", Case("input_out_of_bounds", command={"u": (0.0, -3.5)}), -0.5),
        ("controller", Case("observation_stale", {"observation_ns": NOW - S}), -0.8),
        ("controller", Case("observation_stale", {"observation_ns": NOW + 3 * S}), -3.0),
        ("controller", Case("observation_stale", {"observation_ns": NOW}, settings={"observation_timeout_ns": -2 * S}), -2.0),
        ("controller", Case("certificate_expired", {"unix_s": 2010}), -10.0),
        ("controller", Case("certificate_expired", {"unix_s": 600}), -400.0),
        ("controller", Case("measurement_faults", {"faults": 9}), -6.0),
        ("controller", Case("clock_backwards", now=NOW - 4 * S), -4.0),
        ("controller", Case("settling", {"clear_since_ns": NOW - S // 40}), -0.075),
        ("controller", Case("command_stale", command={"t_ns": NOW - S}), -0.9),
        ("controller", Case("command_stale", command={"t_ns": NOW + 2 * S}), -2.0),
        ("controller", Case("command_stale", {"asked_ns": NOW - 3 * S}), -2.9),
        ("controller", Case("command_stale", command={"ttl_ns": -2 * S}), -2.0),
        ("sampler", Case("permit_expired", {"permit_until_ns": NOW - 2 * S}), -2.0),
        ("sampler", Case("outside_geofence", {"observation": at(0.0, 1.75, 0.0)}), -0.25),
    ],
    ids=lambda value: name(value) if isinstance(value, Case) else str(value),
)
def test_the_margin_says_by_how_much_it_failed_in_the_conditions_own_unit(source: str, case: Case, margin: float) -> None:
    verdict = decide(source, case)
    assert verdict.reason == case.reason
    assert verdict.margin == pytest.approx(margin)


@pytest.mark.parametrize(
    "case",
    [
        Case("radius_above_verified", {"radius": -math.inf}),
        Case("radius_above_verified", certificate={"verified_radius": math.inf}),
        Case("observation_invalid", {"observation": Observation(7, 7, (1.0, 0.5, 1.0), "marked")}),
        Case("outside_region", {"observation": at(0.0, 0.0, 0.0)}, settings={"region": ((-1.6, 1.6), (-1.0, 1.0), (5.0, -math.inf))}),
        Case("outside_region", {"observation": at(-1.6, 0.0, 0.0)}, settings={"region": ((-1.6, math.nan), (-1.0, 1.0), (-4.0, 4.0))}),
        Case("outside_region", {"observation": at(-1.1, 0.0, 0.0)}, settings={"region": ((-1.6, math.nan), (-1.0, 1.0), (-4.0, 4.0))}),
    ],
    ids=name,
)
def test_what_is_no_number_or_marked_as_a_fault_is_refused_even_where_the_comparison_would_pass_it(case: Case) -> None:
    verdict = decide("controller", case)
    assert (verdict.allow, verdict.reason) == (False, case.reason)
    assert verdict.margin < 0.0


def test_a_state_of_another_length_than_its_bounds_or_names_is_outside() -> None:
    two, three = ((-1.0, 1.0),) * 2, ((-1.0, 1.0),) * 3
    assert gate.inside(SETTINGS, (0.0, 0.0, 0.0), two) == gate.NO_NUMBER
    assert gate.inside(SETTINGS, (0.0, 0.0), two) == gate.NO_NUMBER
    assert gate.inside(SETTINGS, (0.0, 0.0), three) == gate.NO_NUMBER
    assert gate.inside(SETTINGS, (0.0, 0.25, 0.0), three) == 0.75


def test_every_reason_the_gate_gives_is_in_the_table_and_every_one_is_reachable() -> None:
    given_here = {case.reason.split(":")[0] for case in BOTH + CONTROLLER + SAMPLER} | {"source_not_allowed"}
    given_by_the_core = {"not_started", "memory_refused", "controller_fault"}
    assert given_here | given_by_the_core == set(gate.REASONS)
    assert len(set(gate.REASONS)) == len(gate.REASONS)
    assert {*gate.ALWAYS_LATCHING, *gate.LATCH_HOLDS_ALL, *gate.ABOUT_COMMAND} <= set(gate.REASONS)


def test_the_document_has_a_row_for_every_reason_and_no_other() -> None:
    text = (Path(__file__).parent.parent / "docs" / "gate.md").read_text(encoding="utf-8")
    rows = re.findall(r"^\| `([a-z_]+)`", text, re.MULTILINE)
    assert sorted(rows) == sorted(gate.REASONS)


def test_what_is_about_a_command_and_what_always_latches_are_the_documents() -> None:
    text = (Path(__file__).parent.parent / "docs" / "gate.md").read_text(encoding="utf-8")
    always = re.findall(r"^\| `([a-z_]+)` \|.*\| always \|", text, re.MULTILINE)
    assert tuple(always) == gate.ALWAYS_LATCHING
    assert gate.REASONS[-5:-1] == gate.ABOUT_COMMAND  # before `settling`, which is nobody's doing
    assert gate.ABOUT_COMMAND == ("command_invalid", "command_out_of_order", "command_stale", "input_out_of_bounds")
    assert gate.ALLOWED == "allowed"


# ---------------------------------------------------------------- properties

_CHANGES = [
    (kind, key, value)
    for case in BOTH + CONTROLLER
    for kind, part in (("situation", case.situation), ("command", case.command), ("settings", case.settings))
    for key, value in part.items()
    if not case.certificate and case.now == NOW
]


def test_no_two_failures_ever_make_up_for_each_other() -> None:
    """Whatever is wrong besides, a failed condition stays failed: checked on every pair of them."""
    singles = {index for index, change in enumerate(_CHANGES) if not _decide_with([change]).allow}
    for one, other in itertools.combinations(range(len(_CHANGES)), 2):
        if _CHANGES[one][:2] != _CHANGES[other][:2] and (one in singles or other in singles):
            assert not _decide_with([_CHANGES[one], _CHANGES[other]]).allow, (_CHANGES[one], _CHANGES[other])


def _decide_with(changes: list[tuple[str, str, Any]]) -> gate.Verdict:
    case = Case("")
    for kind, key, value in changes:
        getattr(case, kind)[key] = value
    return decide("controller", case)


number = st.one_of(st.floats(), st.sampled_from([0.0, 1.6, -1.0, 0.2, MAX, -MAX, 5e-324]))


@settings(max_examples=400, deadline=None)
@given(x=st.tuples(number, number, number), u=st.tuples(number, number))
def test_whatever_the_numbers_the_verdict_is_finite_and_what_passes_is_inside(x: tuple[float, ...], u: tuple[float, ...]) -> None:
    for source, (bx, by) in (("controller", (1.6, 1.0)), ("sampler", (2.0, 1.5))):
        verdict = decide(source, Case("", {"observation": Observation(7, 7, x)}, {"u": u}))
        assert math.isfinite(verdict.margin)
        inside = abs(x[0]) <= bx and abs(x[1]) <= by and math.isfinite(x[2]) and abs(u[0]) <= 0.2 and abs(u[1]) <= 3.0
        assert verdict.allow == inside


@settings(max_examples=200, deadline=None)
@given(theta=st.floats(-1e3, 1e3), middle=st.floats(-10.0, 10.0), half=st.floats(0.01, 3.1))
def test_an_angle_is_judged_on_its_circle(theta: float, middle: float, half: float) -> None:
    region = ((-1.6, 1.6), (-1.0, 1.0), (middle - half, middle + half))
    verdict = decide("controller", Case("", {"observation": at(0.0, 0.0, theta)}, settings={"region": region}))
    off = math.acos(max(-1.0, min(1.0, math.cos(theta - middle))))  # distance on the circle, written another way
    if abs(off - half) > 1e-6:
        assert verdict.allow == (off < half)
