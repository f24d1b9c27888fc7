"""Queues behind the transport's subscriptions: frames, and commands of others without those of its own."""

from __future__ import annotations

import threading
from collections import Counter, deque
from typing import TYPE_CHECKING

from s2r_zenoh.sessions import Doorbell, Inbox

from s2r_ros2.cdr import PAYLOAD_MAX
from s2r_ros2.keys import ATTACHMENT_MAX, envelope

if TYPE_CHECKING:
    import zenoh

PER_SECOND = 32
"""Commands of others that are logged."""
COMMAND_MAX = 4096
"""Bytes of one: a stamped twist has a hundred. So strangers put 130 KB a second into the log at most."""
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


class Ears(Mail):
    """An inbox for others' commands: what left here is known again, and not taken in."""

    def __init__(self, bell: Doorbell) -> None:
        super().__init__(bell, PER_SECOND, PER_SECOND, COMMAND_MAX)
        self._order: deque[bytes] = deque()
        self._own: Counter[bytes] = Counter()
        self._mutex = threading.Lock()

    def sent(self, data: bytes) -> None:
        """This frame is about to leave."""
        with self._mutex:
            self._order.append(data)
            self._own[data] += 1
            if len(self._order) > COMMANDS_KEPT:
                oldest = self._order.popleft()
                self._own[oldest] -= 1
                if not self._own[oldest]:
                    del self._own[oldest]

    def put(self, sample: zenoh.Sample) -> None:
        """Callback of the subscription, on Zenoh's thread."""
        data = self.content(sample)
        with self._mutex:
            own = data in self._own
        if not own:
            super().put(sample)
