"""Queues behind the transport's subscriptions: frames, and commands of others without those of its own."""

from __future__ import annotations

import threading
from collections import deque
from typing import TYPE_CHECKING

from s2r_zenoh.sessions import Doorbell, Inbox

from s2r_ros2.cdr import PAYLOAD_MAX, Malformed
from s2r_ros2.keys import ATTACHMENT_MAX, envelope
from s2r_ros2.payloads import decode_bool

if TYPE_CHECKING:
    import zenoh

PER_SECOND = 32
"""Commands of others that are logged."""
COMMAND_MAX = 4096
"""Bytes of one: a stamped twist has a hundred. So strangers put 130 KB a second into the log at most."""
POSE_MAX = 4096
"""Bytes of a pose that is no list of transforms: an odometry with the longest names has 1300. So that a flood fills no log with more."""
COMMANDS_KEPT = 4096
"""Sent commands that are known again when the ears hear them: 40 s at 100 Hz, when a link that stalled has long been given up."""


class Mail(Inbox):
    """An inbox of frames: attachment and payload; one that is cut is malformed."""

    def __init__(self, bell: Doorbell, capacity: int, per_second: int = 0, longest: int = PAYLOAD_MAX) -> None:
        super().__init__(bell, capacity, per_second, longest)

    def content(self, sample: zenoh.Sample) -> bytes:
        """See `keys.envelope`."""
        extra = sample.attachment
        return envelope(b"" if extra is None else extra.to_bytes()[:ATTACHMENT_MAX], sample.payload.to_bytes()[: self._longest + 1])


class Stops(Mail):
    """An inbox for a button's topic. Where it is full, releases give way, so that no flood of them hides a stop."""

    def put(self, sample: zenoh.Sample) -> None:
        """As `Inbox.put`."""
        if len(self._waiting) >= self._capacity and _is_release(sample.payload.to_bytes()[: self._longest + 1]):
            with self._lock:
                self.received += 1
                self.dropped += 1
            return
        super().put(sample)


def _is_release(payload: bytes) -> bool:
    """Whether it says that the button is not pressed; garbage counts as pressed."""
    try:
        return not decode_bool(payload)
    except Malformed:
        return False


class Ears(Mail):
    """An inbox for others' commands: what left here is known again as often as it left, and not taken in. A replay comes once more."""

    def __init__(self, bell: Doorbell) -> None:
        super().__init__(bell, PER_SECOND, PER_SECOND, COMMAND_MAX)
        self._order: deque[tuple[int, bytes]] = deque()
        self._own: dict[bytes, deque[int]] = {}
        self._sent = 0
        self._mutex = threading.Lock()

    def sent(self, data: bytes) -> None:
        """This frame is about to leave."""
        with self._mutex:
            self._sent += 1
            self._order.append((self._sent, data))
            self._own.setdefault(data, deque()).append(self._sent)
            if len(self._order) > COMMANDS_KEPT:
                number, oldest = self._order.popleft()
                numbers = self._own.get(oldest)
                if numbers and numbers[0] == number:  # it never came back
                    self._came(oldest)

    def _came(self, data: bytes) -> bool:
        """Whether this is one of the own commands that did not come back yet; each does so once."""
        numbers = self._own.get(data)
        if numbers is None:
            return False
        numbers.popleft()
        if not numbers:
            del self._own[data]
        return True

    def put(self, sample: zenoh.Sample) -> None:
        """Callback of the subscription, on Zenoh's thread."""
        data = self.content(sample)
        with self._mutex:
            own = self._came(data)
        if not own:
            super().put(sample)
