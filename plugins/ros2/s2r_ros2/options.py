"""The profile's `[transport]` table: what each option means, its default, and what is wrong with a value."""

from __future__ import annotations

import difflib
import math
import re
from dataclasses import dataclass, fields
from typing import Any

from s2r_ros2.interfaces import ODOMETRY, POSE_STAMPED, TF, TWIST, TWIST_STAMPED
from s2r_ros2.keys import HASHES, LAYOUTS, Layout
from s2r_ros2.pose import POSE_ONLY, QUANTITIES
from s2r_runtime.errors import ConfigError

TWIST_FIELDS = ("linear.x", "linear.y", "linear.z", "angular.x", "angular.y", "angular.z")
USUAL_FIELDS = {"v": "linear.x", "w": "angular.z", "vx": "linear.x", "vy": "linear.y"}
POSES = {"odometry": (ODOMETRY, "odom"), "pose_stamped": (POSE_STAMPED, "pose"), "tf": (TF, "/tf")}
"""Interface and usual topic. A topic with a slash in front is absolute: no namespace goes before it, but a bridge's."""
COMMANDS = {"twist": TWIST, "twist_stamped": TWIST_STAMPED}
STAMPS = ("header", "arrival")
TOPIC = re.compile(r"/?[A-Za-z_]\w*(/[A-Za-z_]\w*)*", re.ASCII)
NAME = re.compile(r"[A-Za-z_]\w*", re.ASCII)
ENDPOINT = re.compile(r"[a-z0-9_-]+/\S+")
DOMAIN_MAX = 232


@dataclass(frozen=True)
class Options:
    """As in MEANINGS, with defaults. `quantities` and `fields` follow: what each state and each input is."""

    robot_listen: str = ""
    robot_connect: str = ""
    controller_listen: str = ""
    controller_connect: str = ""
    layout: str = "bridge"
    domain: int = 0
    namespace: str = ""
    type_hash: str = "RIHS01"
    node: str = "s2r_runtime"
    pose: str = "odometry"
    pose_topic: str = ""
    frame: str = ""
    child_frame: str = ""
    states: tuple[tuple[str, str], ...] = ()
    stamp: str = "header"
    period: float = 0.0
    max_age: float = 0.3
    max_tilt: float = 0.2
    command: str = "twist"
    command_topic: str = "cmd_vel"
    command_frame: str = "base_link"
    inputs: tuple[tuple[str, str], ...] = ()
    command_timeout: float = 0.5
    emergency_stop: str = ""
    manual_override: str = ""
    observation_timeout: float = 0.5
    lease: float = 2.0
    queue: int = 64
    robot_config: str = ""
    controller_config: str = ""
    quantities: tuple[str, ...] = ()
    fields: tuple[str, ...] = ()

    @property
    def keys(self) -> Layout:
        """How topics become keys."""
        return Layout(self.layout, self.domain, self.namespace, self.type_hash)

    @property
    def pose_type(self) -> str:
        """The interface that tells where the robot is."""
        return POSES[self.pose][0]

    @property
    def command_type(self) -> str:
        """The interface by which it is commanded."""
        return COMMANDS[self.command]

    @property
    def overrides(self) -> dict[str, str]:
        """Kind of override -> topic, of those that there are."""
        return {kind: topic for kind in ("emergency_stop", "manual_override") if (topic := getattr(self, kind))}


MEANINGS: dict[str, str] = {
    "robot_listen": "endpoint on which the robot's side reaches the runtime, such as tcp/192.168.7.1:7461",
    "robot_connect": "endpoint to connect to instead, or as well: the robot's bridge or its rmw_zenohd, such as tcp/192.168.7.2:7447",
    "controller_listen": "endpoint for onlookers and other people's controllers; none: they have no way in",
    "controller_connect": "a router on their side; never the robot's",
    "layout": "who speaks for the robot: bridge (zenoh-bridge-ros2dds, the default) or rmw (rmw_zenoh)",
    "domain": "rmw: ROS_DOMAIN_ID (default 0)",
    "namespace": "the bridge's namespace, or that of relative topics under rmw; none by default",
    "type_hash": "rmw: RIHS01 (default), or TypeHashNotSupported for Humble",
    "node": "rmw: name under which the runtime is seen in the robot's graph; empty: not at all (default s2r_runtime)",
    "pose": "what says where the robot is: odometry (the default), pose_stamped or tf",
    "pose_topic": "its topic (default odom, pose or /tf)",
    "frame": "frame_id that the pose must be in (default: that of the first message; tf needs one)",
    "child_frame": "child_frame_id that the pose must be of (likewise)",
    "states": "model state -> x, y, theta, speed, vx, vy or w, where the model has other names; the last four come from odometry's twist",
    "stamp": "header (the default): header.stamp is the robot's clock; arrival: for robots that do not stamp",
    "period": "bridge, and tf: s between two poses as the robot publishes them, so that lost ones are counted (default: they are not)",
    "max_age": "s; a pose that was longer on its way than the fastest by more than this is faulty (default 0.3)",
    "max_tilt": "rad; a robot that is tilted more is not on its plane: a fault (default 0.2)",
    "command": "what the robot is commanded by: twist (the default) or twist_stamped",
    "command_topic": "its topic (default cmd_vel)",
    "command_frame": "twist_stamped: frame_id of commands (default base_link)",
    "inputs": "model input -> linear.x, ..., angular.z, where the model has other names than v and w (or vx and vy)",
    "command_timeout": "s without a command after which the robot stops on its own; bags are read so (default 0.5)",
    "emergency_stop": "topic of type std_msgs/msg/Bool that is true while the robot's button is pressed",
    "manual_override": "the same for a person's stick",
    "observation_timeout": "s without a pose after which the link counts as lost (default 0.5)",
    "lease": "s after which Zenoh gives up a peer that does not answer (default 2)",
    "queue": "messages kept for a runtime that is late; older ones are dropped and counted (default 64)",
    "robot_config": "Zenoh configuration file to start from on the robot's side (certificates, passwords)",
    "controller_config": "the same on the other side",
}
DEFAULTS = {f.name: f.default for f in fields(Options) if f.name in MEANINGS}


def checked(given: dict[str, Any], states: tuple[str, ...], inputs: tuple[str, ...], *, connected: bool = True) -> Options:
    """Options with their defaults. connected: a way to the robot must be there; a bag needs none. Raises ConfigError."""
    values: dict[str, Any] = dict(DEFAULTS)
    for name, value in given.items():
        values[name] = _typed(name, value)
    values["pose_topic"] = values["pose_topic"] or POSES.get(values["pose"], ("", "odom"))[1]
    o = Options(**values)
    for name, known in (("layout", LAYOUTS), ("type_hash", HASHES), ("pose", POSES), ("stamp", STAMPS), ("command", COMMANDS)):
        _choice(name, values[name], tuple(known))
    for name in ("max_age", "max_tilt", "observation_timeout", "lease", "command_timeout"):
        if not 0.0 < values[name] <= (math.pi if name == "max_tilt" else math.inf):
            raise ConfigError(f"transport.{name} is {values[name]}, must be > 0 {'rad' if name == 'max_tilt' else 's'}")
    for name in ("observation_timeout", "lease"):
        if values[name] == math.inf:
            raise ConfigError(f"transport.{name} is inf, must be a number of seconds")
    if not 0.0 <= o.period < math.inf:
        raise ConfigError(f"transport.period is {o.period}, must be >= 0 s")
    if o.queue < 1:
        raise ConfigError(f"transport.queue is {o.queue}, must be >= 1")
    if not 0 <= o.domain <= DOMAIN_MAX:
        raise ConfigError(f"transport.domain is {o.domain}, must be in 0 to {DOMAIN_MAX}")
    _topics(o)
    if o.pose == "tf" and not (o.frame and o.child_frame):
        raise ConfigError("transport: pose = tf needs frame and child_frame, such as odom and base_footprint")
    if connected:
        _endpoints(values)
    quantities = _quantities(o, states)
    return Options(**{**values, "namespace": o.namespace.strip("/"), "quantities": quantities, "fields": _fields(o, inputs)})


def _typed(name: str, value: Any) -> Any:
    if name not in DEFAULTS:
        near = difflib.get_close_matches(name, DEFAULTS, 1, 0.6)
        hint = f"did you mean {near[0]!r}?" if near else f"there are: {', '.join(DEFAULTS)}"
        raise ConfigError(f"transport.{name} is not an option of the ros2 transport; {hint}")
    if name in ("states", "inputs"):
        if not isinstance(value, dict) or not all(isinstance(v, str) for v in value.values()):
            raise ConfigError(f"transport.{name} is {value!r}, must be a table of names")
        return tuple(value.items())
    default = DEFAULTS[name]
    wanted = (int, float) if isinstance(default, float) else type(default)
    if isinstance(value, bool) or not isinstance(value, wanted):
        kind = {str: "text", int: "a whole number", float: "a number"}[type(default)]
        raise ConfigError(f"transport.{name} is {value!r}, must be {kind}")
    return value


def _choice(name: str, value: str, known: tuple[str, ...]) -> None:
    if value not in known:
        near = difflib.get_close_matches(value, known, 1, 0.6)
        raise ConfigError(
            f"transport.{name} is {value!r}, must be one of {', '.join(known)}" + (f"; did you mean {near[0]!r}?" if near else "")
        )


def _topics(o: Options) -> None:
    for name in ("pose_topic", "command_topic", "emergency_stop", "manual_override", "namespace"):
        value = getattr(o, name)
        if value and not TOPIC.fullmatch(value):
            raise ConfigError(f"transport.{name} is {value!r}, must be a ROS name such as /robot1/odom")
    if not o.command_topic:
        raise ConfigError("transport.command_topic is empty, must be a topic such as /cmd_vel")
    if o.node and not NAME.fullmatch(o.node):
        raise ConfigError(f"transport.node is {o.node!r}, must be a ROS node's name such as s2r_runtime")
    taken = [o.keys.name(t) for t in (o.pose_topic, o.command_topic, *o.overrides.values())]
    if len(set(taken)) < len(taken):
        raise ConfigError(f"transport: the topics {', '.join(taken)} must differ")


def _endpoints(values: dict[str, Any]) -> None:
    """As the zenoh transport has them: two sides, and nothing that leads from one to the other."""
    for name in ("robot_listen", "robot_connect", "controller_listen", "controller_connect"):
        if values[name] and not ENDPOINT.fullmatch(values[name]):
            raise ConfigError(f"transport.{name} is {values[name]!r}, must be an endpoint such as tcp/127.0.0.1:7461")
    if not values["robot_listen"] and not values["robot_connect"]:
        raise ConfigError("transport: the ros2 transport needs robot_listen or robot_connect")
    sides = [{values[f"{side}_listen"], values[f"{side}_connect"]} - {""} for side in ("robot", "controller")]
    if shared := sides[0] & sides[1]:
        raise ConfigError(
            f"transport: robot and controllers share {shared.pop()}; whoever reaches both carries commands past the gate, "
            "so each side needs an endpoint or router of its own"
        )


def _quantities(o: Options, states: tuple[str, ...]) -> tuple[str, ...]:
    """What each state is. Only odometry has a twist."""
    there = QUANTITIES if o.pose == "odometry" else POSE_ONLY
    named = dict(o.states)
    for state, quantity in named.items():
        if state not in states:
            raise ConfigError(f"transport.states.{state} is not a state of the model; it has: {', '.join(states)}")
        _choice(f"states.{state}", quantity, there)
    if unknown := [name for name in states if name not in named and name not in there]:
        raise ConfigError(f"transport: ROS 2 with pose = {o.pose} tells {', '.join(there)}; the model also has {', '.join(unknown)}")
    return tuple(named.get(name, name) for name in states)


def _fields(o: Options, inputs: tuple[str, ...]) -> tuple[str, ...]:
    """Where each input goes."""
    named = dict(o.inputs)
    for name, field in named.items():
        if name not in inputs:
            raise ConfigError(f"transport.inputs.{name} is not an input of the model; it has: {', '.join(inputs)}")
        _choice(f"inputs.{name}", field, TWIST_FIELDS)
    if unknown := [name for name in inputs if name not in named and name not in USUAL_FIELDS]:
        raise ConfigError(f"transport.inputs: must say which field of a Twist {', '.join(unknown)} is ({', '.join(TWIST_FIELDS)})")
    found = tuple(named.get(name) or USUAL_FIELDS[name] for name in inputs)
    if len(set(found)) < len(found):
        raise ConfigError(f"transport.inputs: {', '.join(inputs)} go to {', '.join(found)}, must be fields that differ")
    return found
