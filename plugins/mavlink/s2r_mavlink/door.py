"""Where frames come in: who may speak for the robot, and what of it is kept.

A frame is the robot's if it is whole, bears the robot's ids, is signed where there is a key (and isn't where there is none), comes from the
address that the robot has, and stands in the order of its numbers. Of those, what the runtime reads is handed on and logged; the rest is
counted by reason. What is noticed here and matters for what frames mean becomes a frame itself, a note on the channel `door`, so that
the log says it too:

    dropped N                 N messages about the pose gave way, the runtime was late
    rejected REASON=N ...     since the last such note, at most one a second
    twin, alone               two robots answer to one system id, and both hear what is sent to one; only one does again
    elsewhere                 another address sends under the robot's ids what the robot does not send, at most once a second
    refused WHY               a message about the pose came in the robot's name and did not count; the next one after a good one
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass

from s2r_mavlink.dialect import COMMAND_ACK, HEARTBEAT, MESSAGE_INTERVAL, STATUSTEXT, TIMESYNC
from s2r_mavlink.elsewhere import Elsewhere
from s2r_mavlink.endpoints import Endpoint, Piece
from s2r_mavlink.frames import SIGNED, V2, header, payload
from s2r_mavlink.sequence import Sequence
from s2r_mavlink.signing import Signing
from s2r_runtime.messages import Frame

NOTE_NS = 1_000_000_000
REJECTIONS = ("foreign", "bad_signature", "old_stamp", "far_future", "unsigned", "signed_without_key", "other_address")
ANSWERS_MOST = 64
"""Frames about other things than the pose that are kept for a runtime that is late."""
ANSWERS = frozenset((HEARTBEAT, COMMAND_ACK, MESSAGE_INTERVAL, STATUSTEXT, TIMESYNC))


@dataclass
class Told:
    """How often a message about the pose came, when it came last, and the longest time between two since somebody looked."""

    count: int = 0
    newest_ns: int = 0
    gap_ns: int = 0

    def came(self, now_ns: int) -> None:
        """Once more."""
        if self.newest_ns:
            self.gap_ns = max(self.gap_ns, now_ns - self.newest_ns)
        self.count, self.newest_ns = self.count + 1, now_ns


class Door:
    """The robot's side. ids: (system, component) of the autopilot and, where it is another, of who tells the pose.

    received: whole frames that came; rejected: those of them that did not count, by reason; dropped: gave way; told: by message number.
    """

    def __init__(self, ids: frozenset[tuple[int, int]], autopilot: tuple[int, int], pose: frozenset[int], queue: int) -> None:
        self._ids, self._autopilot, self._pose, self._queue = ids, autopilot, pose, queue
        self._tracks = {sender: Sequence() for sender in ids}
        self._elsewhere = Elsewhere()
        self._elsewhere_ns = -NOTE_NS
        self._twin = False
        self._refused, self._clean = "", True
        self._noted: dict[str, int] = {}
        self._note_ns = 0
        self.signing: Signing | None = None
        self.received = self.dropped = 0
        self.questions: deque[int] = deque(maxlen=4)
        self.told = {number: Told() for number in pose}
        self.rejected = dict.fromkeys(REJECTIONS, 0)

    @property
    def lost(self) -> int:
        """Frames of the robot that never came."""
        return sum(track.lost for track in self._tracks.values())

    @property
    def out_of_order(self) -> int:
        """Frames that were off the order of the robot's numbers."""
        return sum(track.off for track in self._tracks.values())

    @property
    def repeated(self) -> int:
        """Frames that came twice."""
        return sum(track.again for track in self._tracks.values())

    def come_in(self, line: Endpoint, pieces: list[Piece]) -> list[Frame]:
        """What of it counts, as frames for the log, in order."""
        frames: list[Frame] = []
        about_pose = 0
        for source, arrival_ns, came in pieces:
            self.received += len(came)
            for data in came:
                self._refused = ""
                number = self._admitted(line, source, arrival_ns, data)
                if self._refused and self._clean and header(data).number in self._pose:  # once after each good one: the log must not fill
                    self._clean = False
                    frames.append(Frame(arrival_ns, "door", b"refused " + self._refused.encode()))
                if number in self._pose:
                    self._clean = True
                    about_pose += 1
                    frames.append(Frame(arrival_ns, "robot", data))
                elif number in ANSWERS and not (number == TIMESYNC and self._question(data)):
                    frames.append(Frame(arrival_ns, "robot", data))
        return self._bounded(frames, about_pose) if len(frames) > self._queue else frames

    def _admitted(self, line: Endpoint, source: object, now_ns: int, data: bytes) -> int:
        """The number of a message that the robot sent and that counts; -1 for any other."""
        v2 = data[0] == V2
        sender = (data[5], data[6]) if v2 else (data[3], data[4])
        track = self._tracks.get(sender)
        if track is None:
            return self._reject("foreign")
        signed = v2 and bool(data[2] & SIGNED)
        if self.signing is not None:
            if reason := self.signing.verify(data, signed=signed):
                if reason == "old_stamp":
                    line.hear(source)
                return self._reject(reason)
        elif signed:
            return self._reject("signed_without_key")
        facts = header(data)
        if not line.accept(source, now_ns):  # whoever it is, it doesn't hear what is sent to the robot
            if facts.number in self._pose:
                self._elsewhere.strange(data)
            return self._reject("other_address")
        if facts.number in self._pose:
            self._elsewhere.own(data, now_ns)
        place = track.place(facts.sequence, now_ns, checked=facts.known)
        if place == "again":
            self._refused = "echo"
        elif place == "off":
            self._refused = "out_of_order"
        if place == "off" or place == "again" or not facts.known:
            return -1
        if facts.number in self._pose:
            self.told[facts.number].came(now_ns)
            return facts.number
        # the pose may be another component's; everything else is the autopilot's to say
        return facts.number if sender == self._autopilot and place == "next" else -1

    def _reject(self, reason: str) -> int:
        self.rejected[reason] += 1
        if reason not in ("foreign", "other_address"):  # somebody else's on a shared line; a copy of the robot's own by another way
            self._refused = reason
        return -1

    def _question(self, data: bytes) -> bool:
        """Whether the robot asks for our time; kept to be answered."""
        content = payload(data).ljust(16, b"\0")
        if content[:8] != bytes(8):
            return False
        self.questions.append(int.from_bytes(content[8:16], "little", signed=True))
        return True

    def _bounded(self, frames: list[Frame], about_pose: int) -> list[Frame]:
        """The newest of what tells the pose, and the newest of all else; what gives way is counted, and noted where it was."""
        surplus = {True: max(0, about_pose - self._queue), False: max(0, len(frames) - about_pose - ANSWERS_MOST)}
        gone = sum(surplus.values())
        kept: list[Frame] = []
        for frame in frames:
            pose = frame.channel == "robot" and header(frame.data).number in self._pose
            if surplus[pose]:
                surplus[pose] -= 1
            else:
                kept.append(frame)
        if gone:
            self.dropped += gone
            kept.insert(0, Frame(kept[0].arrival_ns, "door", b"dropped %d" % gone))
        return kept

    def notes(self, now_ns: int) -> list[Frame]:
        """What was noticed since the last call."""
        made: list[Frame] = []
        twin = any(track.shared(now_ns) for track in self._tracks.values())
        if twin != self._twin:
            self._twin = twin
            made.append(Frame(now_ns, "door", b"twin" if twin else b"alone"))
        if self._elsewhere.shared(now_ns) and now_ns - self._elsewhere_ns >= NOTE_NS:
            self._elsewhere_ns = now_ns
            made.append(Frame(now_ns, "door", b"elsewhere"))
        if now_ns - self._note_ns >= NOTE_NS:
            # somebody else's frames on a shared line are no incident
            counts = {name: count for name, count in self.rejected.items() if name != "foreign"}
            counts["out_of_order"] = self.out_of_order
            new = {name: count - self._noted.get(name, 0) for name, count in counts.items() if count > self._noted.get(name, 0)}
            if new:
                self._note_ns, self._noted = now_ns, counts
                made.append(Frame(now_ns, "door", b"rejected " + " ".join(f"{name}={count}" for name, count in new.items()).encode()))
        return made
