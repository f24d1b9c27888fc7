"""The tracer on measured recordings: MRCLAM (an iRobot Create, commands and Vicon poses on stamps of their own), EMPS (an arm's
prismatic joint, force and position only), F1TENTH (a car, 41 runs), a Clearpath Husky (skid steer, 603 windows) and an ArduPilot rover
in its simulator.

K. Leung et al., The UTIAS multi-robot cooperative localization and mapping dataset, IJRR 30(8), 2011. A. Janot, M. Gautier, M. Brunot,
Data set and reference models of EMPS, 2019. N. Kochdumper, S. Bak, Conformant synthesis for Koopman operator linearized control
systems, 2022. D. Baril et al., DRIVE: data-driven robot input vector exploration, ICRA 2024. The data are not part of this project: the
tests run where S2R_DATA, or a folder beside the repository, holds them.
"""

import os
from pathlib import Path

import pytest
from trace_sets.measured import RECORDINGS, trace_measured

pytestmark = pytest.mark.slow

FOLDER = Path(os.environ.get("S2R_DATA", Path(__file__).parents[2] / "shared" / "data"))


def recorded(name):
    """Marks of a test on one of them."""

    def marked(test):
        there = (FOLDER / RECORDINGS[name].fit).exists()
        return pytest.mark.slow(pytest.mark.skipif(not there, reason="the measured recordings are not here")(test))

    return marked


@recorded("mrclam")
def test_the_delay_of_a_real_robot_is_found_and_its_heading_is_foretold_as_well_as_others_found(tmp_path):
    """Published for this recording at 10 Hz: a transport delay or lag of 0.17 s in w and 0.21 s in v dominates; the one-step heading error
    on held-out data falls from .0133 to .0079 rad by the delay alone.
    """
    found = trace_measured(RECORDINGS["mrclam"], FOLDER, tmp_path)
    delays = [e for e in found.effects if e.name == "input_delay"]
    assert found.verdict in {"traced", "ambiguous"}
    assert {e.channel for e in delays} & {"*", "w"}
    assert 0.14 < delays[0].parameters["delay"][0] < 0.22
    error = found.to_json()["error"]
    before, after = (error[when]["one_step_rms"]["theta"] for when in ("before", "after"))
    assert before == pytest.approx(0.0133, rel=0.12)
    assert after < 0.62 * before
    assert not {f.kind for f in found.faults} - {"dropout"}
    assert len(found.spec.fitted_on) == 3  # the bytes, what they say, and the rows


@recorded("emps_own_step")
def test_the_same_joint_at_its_own_step_gets_a_partial_repair(tmp_path):
    found = trace_measured(RECORDINGS["emps_own_step"], FOLDER, tmp_path)
    friction = {e.name: next(iter(e.parameters.values()))[0] for e in found.partial or found.effects}
    assert friction["viscous_friction"] == pytest.approx(203.5, rel=0.041)
    assert friction["coulomb_friction"] == pytest.approx(20.39, rel=0.06)
    answer = found.to_json()
    after = answer["partial_error"] or answer["error"]["after"]
    assert after["rollout_rms"]["q"] < 0.1 * answer["error"]["before"]["rollout_rms"]["q"]


@recorded("emps")
def test_the_friction_of_a_real_joint_is_named_with_the_published_numbers(tmp_path):
    """Published: Coulomb 20.14 and 20.63 N, viscous 166.7 and 240.4 N s/m by direction; relative force error 5.98 % on the pulses."""
    found = trace_measured(RECORDINGS["emps"], FOLDER, tmp_path)
    assert found.verdict == "traced"
    values = {e.name: {name: value[0] for name, value in e.parameters.items()} for e in found.effects}
    assert set(values) == {"coulomb_friction", "viscous_friction"}
    assert values["coulomb_friction"] == pytest.approx({"force_positive": 20.14, "force_negative": 20.63}, rel=0.01)
    assert values["viscous_friction"] == pytest.approx({"coefficient_positive": 166.7, "coefficient_negative": 240.4}, rel=0.01)
    error = found.to_json()["error"]
    assert error["before"]["input_relative"] > 0.6
    assert error["after"]["input_relative"] < 0.0598


@recorded("f1tenth")
def test_a_real_car_is_foretold_three_seconds_ahead(tmp_path):
    """By others, on another split: 0.036 m over rollouts of 3 s, with a speed lag of 0.14 s and a steering delay of 0.10 s."""
    found = trace_measured(RECORDINGS["f1tenth"], FOLDER, tmp_path)
    values = {(e.name, e.channel): {name: value[0] for name, value in e.parameters.items()} for e in found.effects}
    assert values["input_lag", "speed_cmd"]["time_constant"] == pytest.approx(0.14, abs=0.03)
    assert values["input_delay", "steer_cmd"]["delay"] == pytest.approx(0.10, abs=0.02)
    after = found.to_json()["error"]["after"]["rollout_rms"]
    assert (after["x"] ** 2 + after["y"] ** 2) ** 0.5 < 0.036


@recorded("husky")
def test_what_a_skid_steer_robot_slips_is_found_from_its_wheels(tmp_path):
    """By others, every third step held out: after 2 s 0.554 to 0.261 m, heading 1.51 to 0.24 rad; gains: yaw 0.38, forward 0.80."""
    found = trace_measured(RECORDINGS["husky"], FOLDER, tmp_path)
    values = {e.name: {name: value[0] for name, value in e.parameters.items()} for e in found.effects}
    assert values["track_scale"]["gain"] == pytest.approx(0.38, abs=0.03)
    assert values["longitudinal_slip"]["ratio"] == pytest.approx(0.20, abs=0.03)
    after = found.to_json()["error"]["after"]["rollout_rms"]
    assert (after["x"] ** 2 + after["y"] ** 2) ** 0.5 < 0.261
    assert after["theta"] < 0.245


@recorded("rover")
def test_the_ramps_of_a_rover_are_found_in_its_telemetry_log(tmp_path):
    """Measured on it by other means: v follows as a ramp of 1 m/s² with a delay of 0.20 s, w as one of 2.09 rad/s² with 0.06 s."""
    found = trace_measured(RECORDINGS["rover"], FOLDER, tmp_path)
    assert found.verdict in {"traced", "ambiguous"}
    rates = {e.channel: e.parameters["rate"][0] for e in found.effects if e.name == "input_rate_limit"}
    assert rates["v"] == pytest.approx(1.0, rel=0.06)
    assert rates["w"] == pytest.approx(2.09, rel=0.1)
    error = found.to_json()["error"]
    for state in ("x", "y", "theta"):
        assert error["after"]["rollout_rms"][state] < 0.15 * error["before"]["rollout_rms"][state]
