"""The runtime as a node in the graph of rmw_zenoh, so that `ros2 node list` and `ros2 topic info` show it. No data hang on it (`keys`)."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from s2r_zenoh.sessions import allow

from s2r_ros2.options import Options

if TYPE_CHECKING:
    import zenoh


def rules(o: Options) -> list[dict[str, Any]]:
    """What a session must let through for it."""
    if o.layout != "rmw" or not o.node:
        return []
    graph = [f"@ros2_lv/{o.domain}/**"]
    return [
        allow("runtime_is_there", "egress", ["liveliness_token"], graph),
        allow("others_look", "ingress", ["declare_liveliness_subscriber", "liveliness_query"], graph),
    ]


def declare(session: zenoh.Session, o: Options, publishes: str, hears: str) -> list[zenoh.LivelinessToken]:
    """Tokens of the node, its publisher and its subscription: the topics of pose and command, or the other way round. Keep them."""
    if o.layout != "rmw" or not o.node:
        return []
    kinds = {o.pose_topic: (o.pose_type, o.queue), o.command_topic: (o.command_type, 1)}
    own, keys = str(session.zid()), o.keys
    tokens = [keys.node_token(own, o.node)]
    for number, (what, topic) in enumerate((("MP", publishes), ("MS", hears)), start=1):
        tokens.append(keys.token(own, o.node, number, what, topic, *kinds[topic]))
    return [session.liveliness().declare_token(token) for token in tokens]
