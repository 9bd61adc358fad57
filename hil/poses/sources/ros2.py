"""Poses of ROS 2 topics without an installation of ROS:

PoseStamped, Odometry and TF over DDS, by Eclipse Cyclone DDS.

A body's name is ``TYPE:TOPIC``: ``geometry_msgs/PoseStamped:/vrpn/quad/pose``,
``nav_msgs/Odometry:/quad/odom``, or ``tf2_msgs/TFMessage:/tf:world/quad`` for the transform of
frame quad in frame world. Positions are metres, z up, quaternions xyzw (REP 103); stamps are those
of the header.

On a loopback ``host`` nothing leaves this machine: multicast is off there, and peers are looked for
on it alone.

Source: REP 103, REP 105; ROS 2 design, Topic and Service name mapping to DDS (``rt/`` before the
topic, ``::msg::dds_::NAME_``)."""

import dataclasses
from collections.abc import Iterator
from typing import Any

from hil.errors import SourceError
from hil.poses.pose import Pose
from hil.poses.sources.motion_capture import MocapParams, MocapSource
from visthrow.common.extras import load_extra

KINDS = ("geometry_msgs/PoseStamped", "nav_msgs/Odometry", "tf2_msgs/TFMessage")

MOST_TAKEN = 100  # most messages of a topic read in one call

LOOPBACK = """<CycloneDDS><Domain>
<General>
<Interfaces><NetworkInterface address="127.0.0.1"/></Interfaces>
<AllowMulticast>false</AllowMulticast>
</General>
<Discovery>
<ParticipantIndex>auto</ParticipantIndex>
<MaxAutoParticipantIndex>100</MaxAutoParticipantIndex>
<Peers><Peer address="127.0.0.1"/></Peers>
</Discovery>
</Domain></CycloneDDS>"""

NETWORK = (
    "<CycloneDDS><Domain><General><Interfaces><NetworkInterface"
    ' address="{}"/></Interfaces></General></Domain></CycloneDDS>'
)


STRUCTURES = """
builtin_interfaces/Time sec:int32 nanosec:uint32
std_msgs/Header stamp:Time frame_id:string
geometry_msgs/Point x:float64 y:float64 z:float64
geometry_msgs/Vector3 x:float64 y:float64 z:float64
geometry_msgs/Quaternion x:float64 y:float64 z:float64 w:float64
geometry_msgs/Pose position:Point orientation:Quaternion
geometry_msgs/Twist linear:Vector3 angular:Vector3
geometry_msgs/PoseWithCovariance pose:Pose covariance:float64[36]
geometry_msgs/TwistWithCovariance twist:Twist covariance:float64[36]
geometry_msgs/Transform translation:Vector3 rotation:Quaternion
geometry_msgs/TransformStamped header:Header child_frame_id:string transform:Transform
geometry_msgs/PoseStamped header:Header pose:Pose
nav_msgs/Odometry header:Header child_frame_id:string pose:PoseWithCovariance \
twist:TwistWithCovariance
tf2_msgs/TFMessage transforms:TransformStamped[]
"""
"""Messages that are read, and their parts, those first of which others are made."""


def message_types() -> dict[str, Any]:
    """Return the messages that are read, by name, as Cyclone DDS has them; raises `SourceError`
    where the package is missing.
    """
    idl = load_extra("cyclonedds.idl", "ros2", "ROS 2 topics", SourceError)
    types = load_extra("cyclonedds.idl.types", "ros2", "ROS 2 topics", SourceError)
    primitives: dict[str, Any] = {"string": str, "float64[36]": types.array[types.float64, 36]}
    primitives |= {name: getattr(types, name) for name in ("float64", "int32", "uint32")}
    messages = {}
    for line in STRUCTURES.split("\n")[1:-1]:
        full_name, *fields = line.split()
        package, name = full_name.split("/")
        kinds = dict(field.split(":") for field in fields)
        notes = {"__annotations__": {field: primitives[kind] for field, kind in kinds.items()}}
        typename = f"{package}::msg::dds_::{name}_"
        meta = type(idl.IdlStruct)(
            name, (idl.IdlStruct,), {**notes, "__module__": __name__}, typename=typename
        )
        primitives[name] = messages[full_name] = dataclasses.dataclass(meta)
        primitives[f"{name}[]"] = types.sequence[primitives[name]]
    return messages


def domain(params: MocapParams) -> Any:
    """Return what joins the ROS domain of ``settings.domain``, 0 where left out; raises
    `SourceError` for a wrong number or address.
    """
    dds = load_extra("cyclonedds.domain", "ros2", "ROS 2 topics", SourceError)
    number = params.settings.get("domain", "0")
    if not number.isdecimal() or not int(number) <= 232:
        raise SourceError(
            f"source.mocap.settings.domain '{number}'; expected ROS_DOMAIN_ID, 0 to 232"
        )
    try:
        participant = dds.Domain(
            int(number), LOOPBACK if params.host.startswith("127.") else NETWORK.format(params.host)
        )
        return participant, dds.DomainParticipant(int(number))
    except Exception as error:  # of the package
        raise SourceError(
            f"DDS on {params.host}, domain {number}: {error}; expected the address of a network"
            " card of ours"
        ) from error


def read_placements(
    kind: str, message: Any, frames: str
) -> Iterator[tuple[float, tuple[float, ...], tuple[float, ...]]]:
    """Yield the stamp [s], position [m] and quaternion xyzw of a message; of TF of the transform
    ``PARENT/CHILD``.
    """
    parent, _, child = frames.rpartition("/")
    if kind == KINDS[2]:
        transforms = [
            t
            for t in message.transforms
            if (t.header.frame_id.lstrip("/"), t.child_frame_id.lstrip("/")) == (parent, child)
        ]
        placements = [(t.header, t.transform.translation, t.transform.rotation) for t in transforms]
    else:
        pose = message.pose if kind == KINDS[0] else message.pose.pose
        placements = [(message.header, pose.position, pose.orientation)]
    for header, p, q in placements:
        yield (
            float(header.stamp.sec) + 1e-9 * float(header.stamp.nanosec),
            (p.x, p.y, p.z),
            (q.x, q.y, q.z, q.w),
        )


def _topic(name: str) -> tuple[str, str, str]:
    """Return type, topic and, of TF, ``PARENT/CHILD`` of a body's name."""
    kind, _, address = name.partition(":")
    place, _, frames = address.partition(":")
    if kind not in KINDS or not place.startswith("/") or (kind == KINDS[2]) != ("/" in frames):
        raise SourceError(
            f"body named '{name}'; expected TYPE:TOPIC with a type of {', '.join(KINDS)}, such as"
            f" {KINDS[0]}:/quad/pose, or {KINDS[2]}:/tf:world/quad"
        )
    return kind, place, frames


class Ros2Source(MocapSource):
    """Poses of topics; each is taken by a thread of the DDS library as it comes."""

    _domain: Any

    def _connect(self) -> None:
        """Subscribe. Raises `SourceError` for a name that is no ``TYPE:TOPIC``."""
        topics = [(*_topic(name), body) for name, body in self._names.items()]
        types = message_types()
        self._domain = domain(self._params)
        core, sub, topic = (
            load_extra(f"cyclonedds.{name}", "ros2", "ROS 2 topics", SourceError)
            for name in ("core", "sub", "topic")
        )
        quality = core.Qos(core.Policy.Reliability.BestEffort, core.Policy.History.KeepLast(10))
        self._readers = []
        for kind, place, frames, body in topics:
            described = topic.Topic(self._domain[1], f"rt{place}", types[kind])
            self._readers.append(
                sub.DataReader(
                    self._domain[1],
                    described,
                    qos=quality,
                    listener=self._listener(core, kind, place, body, frames),
                )
            )

    def _listener(self, core: Any, kind: str, place: str, body: str, frames: str) -> Any:
        source = self

        class Listener(core.Listener):
            def on_data_available(self, reader: Any) -> None:
                try:
                    messages = reader.take(MOST_TAKEN)
                except Exception as error:  # of the package: a sample that it cannot read
                    source.drop(place, f"does not parse ({type(error).__name__})")
                    return
                for message in messages:
                    source.take(message, kind, place, body, frames)

        return Listener()

    def drop(self, place: str, why: str) -> None:
        """Count a message of a topic that is not a pose."""
        self.roster.drop((place, 0), "message", why)

    def take(self, message: Any, kind: str, place: str, body: str, frames: str) -> None:
        """Process a message of a topic; only the first publisher of a body's poses is accepted."""
        arrival = self._clock()
        if not hasattr(message, "__dataclass_fields__"):  # a publisher has appeared or disappeared
            return
        try:
            poses = list(read_placements(kind, message, frames))
        except Exception as error:  # whatever the package made of what came
            self.drop(place, f"does not parse ({type(error).__name__})")
            return
        writer = f"publisher {message.sample_info.publication_handle} of {place}"
        if poses and self.roster.claim(body, (writer, 0), arrival):
            for stamp, pos, quat in poses:
                self.hand_over(Pose(stamp, arrival, body, pos, quat))

    def close(self) -> None:
        for reader in self._readers:
            reader.set_listener(None)
        self._readers.clear()
        self._domain = None
        super().close()
