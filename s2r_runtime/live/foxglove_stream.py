"""The channels for viewers over the Foxglove WebSocket protocol: Foxglove and Lichtblick connect to it."""

from __future__ import annotations

import json
import threading
from collections.abc import Collection, Iterable
from typing import Any

from s2r_runtime.errors import ConfigError
from s2r_runtime.live.origins import Door, random_loopback
from s2r_runtime.live.series import SCENE, Sample, Topic

PORT = 8765
"""What viewers expect."""
BACKLOG = 256
"""Messages that wait for a client at most; then the oldest are dropped."""


class Stream:
    """A server at host:port. topics: the channels that there will be. allowed: see `Door`.

    Raises ConfigError without the SDK, UsageError if the port is taken.
    """

    def __init__(self, name: str, host: str, port: int, topics: Iterable[Topic], allowed: Collection[str] = ()) -> None:
        try:
            import foxglove
        except ImportError:
            raise ConfigError("s2r live --foxglove: needs foxglove-sdk: pip install 's2r-runtime[live]'") from None
        foxglove.set_log_level("CRITICAL")  # it writes a line for each mistake of a client, and waits where nobody reads them
        self._new_channel, self._context = foxglove.Channel, foxglove.Context()
        self._channels: dict[str, tuple[Topic, Any]] = {}
        self._newcomer = threading.Event()
        behind = random_loopback()
        from foxglove.websocket import Capability

        listener: Any = _Listener(self._newcomer)
        self._server = foxglove.start_server(
            name=name,
            host=behind,
            port=0,
            capabilities=[Capability.Time],
            server_listener=listener,
            context=self._context,
            message_backlog_size=BACKLOG,
        )
        try:
            for topic in topics:  # before anybody connects: the SDK may miss to advertise a channel that is made at that moment
                self._channel(topic)
            self._door = Door(host, port, (behind, self._server.port), allowed)
        except BaseException:
            self._server.stop()
            raise
        self.port = self._door.port

    def send(self, sample: Sample) -> None:
        """Hands a message to whoever wants its channel. Never waits."""
        channel = self._channel(sample.topic)
        if channel.has_sinks():
            channel.log(json.dumps(sample.data).encode(), log_time=sample.log_ns)

    def _channel(self, topic: Topic) -> Any:
        """The SDK's channel of this topic; a topic whose type has changed gets a new one."""
        known, channel = self._channels.get(topic.name, (None, None))
        if known != topic:
            if channel is not None:
                channel.close()
            channel = self._new_channel(topic.name, schema=json.loads(topic.schema), context=self._context)
            self._channels[topic.name] = (topic, channel)
        return channel

    def time(self, log_ns: int) -> None:
        """Gives viewers the time in the log: in a replay theirs is another."""
        self._server.broadcast_time(log_ns)

    def newcomer(self) -> bool:
        """Whether somebody wants the scene since the last call: he has seen nothing of what stands still."""
        if self._newcomer.is_set():
            self._newcomer.clear()
            return True
        return False

    def close(self) -> None:
        """Ends it."""
        self._door.close()
        self._server.stop()


class _Listener:
    """What clients do that anybody needs to know. (The SDK looks up the other methods and does without.)"""

    def __init__(self, newcomer: threading.Event) -> None:
        self._newcomer = newcomer

    def on_subscribe(self, _client: Any, channel: Any) -> None:
        if channel.topic == SCENE.name:
            self._newcomer.set()
