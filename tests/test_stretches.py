"""Which rows a trace is made on: cut out of a log's messages, the same by whoever reads them."""

from __future__ import annotations

import random
from typing import Any

from core_rig import SETTINGS

from s2r_runtime import messages as m
from s2r_runtime.recording.stretches import BEFORE_NS, Cut, Stretches, log_identity

DT = 50_000_000
GAP = m.Gap(0.01, 0.1, 0.1, 50, "ball", (1.0,), 160, 0, 0.03, 0.0152, 1, "model", "transitions")


class Log:
    """Messages with their numbers, of one robot in lockstep."""

    def __init__(self, limit: int = 1000, run: str = "a") -> None:
        self.stretches = Stretches(limit)
        self.stretches.begin_run(run)
        self.index = self.seq = self.t = 0

    def put(self, message: m.Struct) -> int:
        self.index += 1
        self.stretches.take(self.index, message)
        return self.index

    def step(self, n: int = 1, source: str = "sampler") -> None:
        """The robot is seen and told what to do."""
        for _ in range(n):
            self.seq += 1
            self.t += DT
            self.put(m.Observed(self.t, m.Observation(self.seq, self.t, (float(self.seq),))))
            self.put(m.Send(self.t, self.seq, source, (0.1 * self.seq,), self.seq, DT))  # type: ignore[arg-type]

    def cut(self, stretch: Any, epoch: int = 1) -> Cut:
        found = self.stretches.cut(stretch, epoch)
        assert found is not None
        return found


def states(cut: Cut) -> list[list[float]]:
    return [[x[0] for _, x in one.states] for one in cut.segments]


def campaign(log: Log, epoch: int = 1, *, resume: bool = False) -> None:
    log.put(m.StartCampaign(log.t, epoch, 3, 0.1, 1, resume))


def test_a_campaign_is_what_was_recorded_while_it_was_under_way_and_what_it_was_asked_first() -> None:
    log = Log()
    log.step(5)
    campaign(log)
    log.step(3)
    log.put(m.CampaignFinished(log.t, 1, 3, True, {}))
    log.step(2)
    cut = log.cut("campaign")
    assert states(cut) == [[5.0, 6.0, 7.0, 8.0]]
    assert cut.about.observations == 4
    assert [part.run for part in cut.about.parts] == ["a"]
    assert log.stretches.cut("campaign", 2) is None
    assert log.stretches.cut("drive", 1) is None


def test_an_interrupted_campaign_goes_on_in_the_next_log_and_another_one_begins_anew() -> None:
    log = Log()
    campaign(log)
    log.step(2)
    log.stretches.begin_run("b")
    log.index = log.seq = log.t = 0
    log.step(1)
    campaign(log, resume=True)
    log.step(2)
    cut = log.cut("campaign")
    assert states(cut) == [[1.0, 2.0], [1.0, 2.0, 3.0]]
    assert [(part.run, part.first, part.last) for part in cut.about.parts] == [("a", 2, 5), ("b", 1, 7)]
    campaign(log, 2)
    log.step(1)
    assert states(log.cut("campaign", 2)) == [[3.0, 4.0]]


def test_a_drive_is_while_a_controller_drives_since_the_gap_in_force() -> None:
    log = Log()
    log.put(m.StartController(log.t, "c", "id"))
    log.step(2, "controller")
    log.put(m.EpochChanged(log.t, 1, 0.1, GAP))
    log.put(m.StopController(log.t, "undeployed"))
    log.step(1, "recovery")
    log.put(m.StartController(log.t, "c", "id"))
    log.step(2, "controller")
    log.put(m.SourceStopped(log.t, "controller", "died"))
    log.step(3, "recovery")
    log.put(m.StartController(log.t, "c", "id"))
    log.step(1, "controller")
    assert states(log.cut("drive")) == [[3.0, 4.0, 5.0], [8.0, 9.0]]
    log.stretches.begin_run("b")
    assert log.stretches.cut("drive", 1) is None, "another log, another drive"


def test_inputs_are_the_newest_ones_every_time_that_they_were_driven() -> None:
    log = Log()
    for digest in ("one", "two", "two"):
        log.put(m.StartInputs(log.t, digest, 2))
        log.step(2)
        log.put(m.InputsFinished(log.t, digest, 2, True))
        log.step(1)
    assert states(log.cut("inputs")) == [[3.0, 4.0, 5.0], [6.0, 7.0, 8.0]]


def test_the_newest_rows_are_kept_with_the_commands_that_still_act_on_them() -> None:
    log = Log(limit=10)
    campaign(log)
    log.step(200)
    cut = log.cut("campaign")
    assert states(cut) == [[float(k) for k in range(191, 201)]]
    (one,) = cut.segments
    assert one.inputs[0][0] >= one.states[0][0] - BEFORE_NS - DT
    assert one.inputs[0][0] < one.states[0][0] - BEFORE_NS + DT
    assert cut.about.parts[0].last == log.index


def test_a_robot_that_was_started_anew_begins_another_segment_and_what_cannot_be_used_is_left_out() -> None:
    log = Log()
    campaign(log)
    log.step(2)
    log.put(m.Observed(log.t, m.Observation(99, log.t + 9, (), "malformed")))
    log.put(m.Observed(log.t, m.Observation(2, log.t, (2.0,))))  # a repetition
    log.put(m.Send(log.t, 1, "sampler", (1.0,), 77, DT))  # answers nothing that was seen
    log.t, log.seq = 0, 0
    log.step(2)
    cut = log.cut("campaign")
    assert states(cut) == [[1.0, 2.0], [1.0, 2.0]]
    assert cut.about.commands == 4


def test_a_command_stands_where_its_observation_does_and_later_by_what_the_daemon_took() -> None:
    log = Log()
    log.put(m.StartInputs(0, "one", 1))
    log.put(m.Observed(1000, m.Observation(1, 70, (0.0,))))
    log.put(m.Send(1007, 1, "sampler", (0.5,), 1, DT))
    assert log.cut("inputs").segments[0].inputs == ((77, (0.5,)),)


def test_the_digest_is_of_every_row_and_stamp() -> None:
    def cut(change: int = 0, shift: int = 0) -> Cut:
        log = Log()
        log.t = shift
        campaign(log)
        log.step(5)
        if change:
            log.put(m.Observed(log.t + DT, m.Observation(9, log.t + DT, (change * 1e-12,))))
        return log.cut("campaign")

    digests = {one.about.digest for one in (cut(), cut(), cut(1), cut(2), cut(shift=1))}
    assert len(digests) == 4


def test_many_rows_cost_little_memory_and_time() -> None:
    rng = random.Random(1)
    log = Log(limit=500)
    campaign(log)
    for _ in range(20):
        log.step(rng.randrange(1000))
    assert log.cut("campaign").about.observations == 500
    assert len(log.stretches._stamps) <= 1024


def test_a_log_is_known_again_by_its_run_and_its_key() -> None:
    assert log_identity("run", b"key") == log_identity("run", b"key")
    assert len({log_identity("run", b"key"), log_identity("run", b"other"), log_identity("other", b"key")}) == 3


def test_a_link_that_was_lost_begins_a_segment_and_no_command_from_before_belongs_to_it() -> None:
    log = Log()
    log.put(m.Started(0, 0, SETTINGS, m.Memory(robot="rig", schema=m.MEMORY_SCHEMA)))
    campaign(log)
    log.step(3)
    log.put(m.LinkChanged(log.t, up=False))
    log.put(m.Send(log.t, 99, "recovery", (7.0,), log.seq, DT))
    log.put(m.LinkChanged(log.t, up=True))
    log.step(2)
    cut = log.cut("campaign")
    assert states(cut) == [[1.0, 2.0, 3.0], [4.0, 5.0]]
    assert 7.0 not in [u[0] for one in cut.segments for _, u in one.inputs]
