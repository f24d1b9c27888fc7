"""Channels for viewers, made of a log's messages: quantities under their names, poses, transforms, and a scene.

    /state      the observed states, by name                        one a usable observation
    /input      the inputs that went to the robot, by name          one a command
    /residual   measured less predicted, by state                   one a control period whose model runs here
    /watch      discrepancy, gap, gap_measured, verified_radius, e_value, e_value_limit     every 100 ms
    /gate       open (0 or 1), reason, driving                      every 100 ms, and at each change
    /pose, /tf  foxglove.PoseInFrame, foxglove.FrameTransforms      one an observation of x and y
    /scene      foxglove.SceneUpdate: region, geofence, goals, obstacles     every second; what moves, every 100 ms
    /events     foxglove.Log: what happened, in words

They are made here and not by the daemon, so that not one more byte goes through its recorder. Times are the log's, which are the daemon's
clock, moved to the wall clock at the run's start as the log has it, to the second. A wall clock that is set during a run moves nothing. SI
units and radians.
"""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from s2r_runtime import messages as m
from s2r_runtime.core import stream
from s2r_runtime.live import scene, schemas
from s2r_runtime.live.feed import Row
from s2r_runtime.live.schemas import Json
from s2r_runtime.live.simulation import Simulation
from s2r_runtime.live.words import BAD, Words
from s2r_runtime.recording.channels import CHANNELS

STEADY_NS = 100_000_000
SCENE_NS = 1_000_000_000
GAP_NS = 1_000_000_000
"""A steady series has no values in a pause that is longer: nobody knows them."""
HEADINGS = ("theta", "yaw", "psi", "heading")
"""What the state is called that turns the robot in the plane, if the model says that it is an angle."""
WANTED = frozenset(CHANNELS) - {"frame/in", "frame/out", "log/chain", "out/persist", "out/decided", "event/sample_taken"}
"""Channels that something here is made of."""
WATCH = schemas.table(
    "s2r.Watch", discrepancy=schemas.NUMBER, gap=schemas.NUMBER, gap_measured=schemas.NUMBER, verified_radius=schemas.NUMBER,
    e_value=schemas.NUMBER, e_value_limit=schemas.NUMBER, measured=schemas.INTEGER, exceedances=schemas.INTEGER,
)  # fmt: skip
GATE = schemas.table("s2r.Gate", open=schemas.INTEGER, reason=schemas.TEXT, detail=schemas.TEXT, driving=schemas.TEXT)


class Topic(NamedTuple):
    """A channel: its name, its type's name, and that type as JSON Schema."""

    name: str
    schema_name: str
    schema: str


class Sample(NamedTuple):
    """A message for a viewer: JSON."""

    topic: Topic
    log_ns: int
    data: Json


def _topic(name: str, schema: Json) -> Topic:
    return Topic(name, schema["title"], json.dumps(schema))


def topics(settings: m.Settings) -> dict[str, Topic]:
    """Every channel of a run with these settings, by name."""
    state = schemas.table("s2r.State", **dict.fromkeys(settings.states, schemas.NUMBER))
    given = schemas.table("s2r.Input", **dict.fromkeys(settings.inputs, schemas.NUMBER), source=schemas.TEXT)
    residual = schemas.table("s2r.Residual", **dict.fromkeys(settings.states, schemas.NUMBER))
    named = [_topic("/state", state), _topic("/input", given), _topic("/residual", residual)]
    return {one.name: one for one in (*named, WATCHED, GATED, EVENTS, *((POSE, TF, SCENE) if {"x", "y"} <= set(settings.states) else ()))}


POSE = _topic("/pose", schemas.POSE_IN_FRAME)
TF = _topic("/tf", schemas.TRANSFORMS)
SCENE = _topic("/scene", schemas.SCENE)
EVENTS = _topic("/events", schemas.LOG)
WATCHED = _topic("/watch", WATCH)
GATED = _topic("/gate", GATE)


class Series:
    """`take` every row of a log, in order. attached: the log's files, by name, as the feed meets them. folder: of the log."""

    def __init__(self, attached: Mapping[str, bytes], folder: Path) -> None:
        self._words = Words()
        self.simulation = Simulation(attached, folder)
        self._settings: m.Settings | None = None
        self._offset_ns = 0
        self._next_ns = self._shown_ns = 0
        self._certificates: dict[str, float] = {}
        self._watch: Json = {}
        self._gate: Json = {"open": 0, "reason": "", "detail": "", "driving": ""}
        self._drawn: object = None
        self._out: list[Sample] = []

    def begin(self, started: m.Started, status: Mapping[str, Any]) -> None:
        """Goes on in the middle of a run, whose beginning is `started`, where the daemon's status is this (docs/json.md)."""
        self._start(started, str(status["model"]))
        known = {"gap": "radius", "gap_measured": "gap_radius", "verified_radius": "verified_radius", "e_value": "e_value"}
        self._watch |= {name: status[key] for name, key in known.items() if status.get(key) is not None}
        self._gate |= {"open": int(status["gate"] == "open"), "reason": str(status["reason"]), "driving": str(status["driving"] or "")}

    def take(self, row: Row) -> list[Sample]:
        """What a row adds."""
        self._out = []
        message = row.message
        if isinstance(message, m.Started):
            self._start(message, message.settings.model_digest)
        if self._settings is None:
            return []
        ns = row.log_ns + self._offset_ns
        self._steady(ns)
        self.simulation.take(message)
        self._take(ns, message, self._settings)
        for words in self._words.take(message):
            level = schemas.ERROR if isinstance(message, BAD) else schemas.INFO
            data = {"timestamp": schemas.time(ns), "level": level, "message": words, "name": self._settings.robot, "file": "", "line": 0}
            self._out.append(Sample(EVENTS, ns, data))
        return self._out

    def scene(self, ns: int) -> Sample | None:
        """All that stands around the robot, for whoever has seen nothing yet; None before a run, and without x and y."""
        if self._settings is None or self._place is None:
            return None
        view = self.simulation.view
        entities = scene.bounds(self._settings, ns) + ([] if view is None else scene.scenario(view, ns))
        gone = [] if view is not None else [{"timestamp": schemas.time(ns), "type": schemas.MATCHING_ID, "id": name} for name in _TASK]
        return Sample(SCENE, ns, {"deletions": gone, "entities": entities})

    # ---- the beginning of a run

    def _start(self, started: m.Started, model_digest: str) -> None:
        settings, memory = started.settings, started.memory
        self._settings, self._offset_ns = settings, started.unix_s * 1_000_000_000 - started.t_ns
        self.simulation.begin(settings, model_digest)
        named = topics(settings)
        self._state, self._input, self._residual = named["/state"], named["/input"], named["/residual"]
        self._place = (settings.states.index("x"), settings.states.index("y")) if {"x", "y"} <= set(settings.states) else None
        headings = [settings.states.index(name) for name in HEADINGS if name in settings.angles and name in settings.states]
        self._heading = headings[0] if headings else None
        self._height = settings.states.index("z") if "z" in settings.states else None
        self._certificates = {facts.id: facts.verified_radius for facts in memory.certificates}
        self._watch = {"e_value_limit": 1.0 / settings.alpha} if settings.alpha > 0.0 else {}
        if memory.gap is not None:
            stood = stream.stood(memory)
            self._watch |= {"gap": memory.radius, "gap_measured": memory.gap.radius, "e_value": stood.e_value}
        self._verified(max(self._certificates.values(), default=None))

    # ---- messages

    def _take(self, ns: int, message: m.Struct, settings: m.Settings) -> None:
        match message:
            case m.Observed(observation=observation) if not observation.fault and len(observation.x) == len(settings.states):
                self._observed(ns, observation, settings)
            case m.Send(u=u, source=source) if len(u) == len(settings.inputs):
                self._gate["driving"] = source
                self._out.append(Sample(self._input, ns, {**dict(zip(settings.inputs, u, strict=True)), "source": source}))
            case m.GateChanged():
                self._gate |= {"open": int(message.open), "reason": message.reason, "detail": message.detail}
                self._out.append(Sample(GATED, ns, dict(self._gate)))
            case m.Measured(fault=""):
                counts = {"measured": message.n, "exceedances": message.exceedances}
                self._watch |= {"discrepancy": message.discrepancy, "e_value": message.e_value, **counts}
            case m.EpochChanged(gap=m.Gap() as gap):
                self._watch |= {"gap": gap.radius, "gap_measured": gap.radius}
                self._verified(None)
            case m.RadiusGrew(radius=radius):
                self._watch["gap"] = radius
            case m.CertificateInstalled(facts=facts):
                self._certificates[facts.id] = facts.verified_radius
                self._verified(facts.verified_radius)
            case m.StartController(certificate_id=identity):
                self._verified(self._certificates.get(identity))
            case m.Revoked(certificate_id=identity):
                self._certificates.pop(identity, None)
                self._verified(max(self._certificates.values(), default=None))
            case _:
                pass

    def _observed(self, ns: int, observation: m.Observation, settings: m.Settings) -> None:
        x = observation.x
        self._out.append(Sample(self._state, ns, dict(zip(settings.states, x, strict=True))))
        residual = self.simulation.residual
        if residual is not None and np.all(np.isfinite(residual)):
            self._out.append(Sample(self._residual, ns, dict(zip(settings.states, map(float, residual), strict=True))))
        if self._place is None:
            return
        angle = 0.0 if self._heading is None else x[self._heading]
        height = 0.0 if self._height is None else x[self._height]
        place = schemas.pose(x[self._place[0]], x[self._place[1]], height, angle)
        at = schemas.time(ns)
        self._out.append(Sample(POSE, ns, {"timestamp": at, "frame_id": scene.FRAME, "pose": place}))
        names = {"timestamp": at, "parent_frame_id": scene.FRAME, "child_frame_id": settings.robot}
        moved = {**names, "translation": place["position"], "rotation": place["orientation"]}
        self._out.append(Sample(TF, ns, {"transforms": [moved]}))

    def _verified(self, radius: float | None) -> None:
        self._watch.pop("verified_radius", None)
        if radius is not None:
            self._watch["verified_radius"] = radius

    def _steady(self, ns: int) -> None:
        """Values that hold until they change, at a steady rate up to now."""
        if not self._next_ns <= ns + STEADY_NS <= self._next_ns + GAP_NS:  # a pause, or the clock was set
            self._next_ns = ns
        while self._next_ns <= ns:
            self._out.append(Sample(GATED, self._next_ns, dict(self._gate)))
            watch = {name: value for name, value in self._watch.items() if isinstance(value, int) or math.isfinite(value)}
            self._out.append(Sample(WATCHED, self._next_ns, watch))
            self._next_ns += STEADY_NS
        view = self.simulation.view
        came = (view is None) != (self._drawn is None)
        since_ns = ns - self._shown_ns
        if came or not 0 <= since_ns < (SCENE_NS if view is self._drawn else STEADY_NS):
            self._drawn, self._shown_ns = view, ns
            shown = self.scene(ns)
            if shown is not None:
                self._out.append(shown)


_TASK = ("goals", "obstacles")
"""Entities that a scenario has."""
