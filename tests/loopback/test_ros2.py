"""Poses of ROS 2 topics between two processes, over DDS on loopback; without ROS on either side."""

import subprocess
import sys
import time

from pytest import importorskip, mark, raises

from hil.errors import SourceError
from hil.poses.sources.motion_capture import MocapParams, RigidBody
from hil.poses.sources.ros2 import KINDS, Ros2Source

importorskip("cyclonedds", reason="extra ros2")

DOMAIN = "57"

PUBLISHER = """
import sys, time
from cyclonedds.pub import DataWriter
from cyclonedds.topic import Topic
from hil.poses.sources.motion_capture import MocapParams
from hil.poses.sources.ros2 import KINDS, domain, message_types
types = message_types()
own, member = domain(MocapParams("ros2", "127.0.0.1", settings={"domain": sys.argv[1]}))
def made(of, **values):
    return of(**values)
fields = lambda kind: kind.__annotations__
Pose, Odometry, Moved = (types[kind] for kind in KINDS)
Header = fields(Pose)["header"]; Stamp = fields(Header)["stamp"]
Placed = fields(Pose)["pose"]
Point, Turn = fields(Placed)["position"], fields(Placed)["orientation"]
Spread, Twisted = fields(Odometry)["pose"], fields(Odometry)["twist"]
Twist = fields(Twisted)["twist"]
Vector = fields(Twist)["linear"]
One = fields(Moved)["transforms"].__metadata__[0].subtype; Transform = fields(One)["transform"]
writers = [DataWriter(member, Topic(member, name, kind)) for name, kind in
           (("rt/quad/pose", Pose), ("rt/ball/odom", Odometry), ("rt/tf", Moved))]
turn = Turn(x=0.0, y=0.0, z=0.6, w=0.8)
for n in range(200):
    header = Header(stamp=Stamp(sec=1000 + n, nanosec=250000000), frame_id="world")
    place = Placed(position=Point(x=1.0 + n, y=2.0, z=3.0), orientation=turn)
    zero, unknown = Vector(x=0.0, y=0.0, z=0.0), [0.0] * 36
    still = Twisted(twist=Twist(linear=zero, angular=zero), covariance=unknown)
    writers[0].write(Pose(header=header, pose=place))
    spread = Spread(pose=place, covariance=unknown)
    writers[1].write(Odometry(header=header, child_frame_id="ball", pose=spread, twist=still))
    at = lambda x: Transform(translation=Vector(x=x, y=0.0, z=0.0), rotation=turn)
    moved = lambda child, x: One(header=header, child_frame_id=child, transform=at(x))
    writers[2].write(Moved(transforms=[moved("other", -1.0), moved("goal", 5.0 + n)]))
    time.sleep(0.02)
"""


def test_poses_come_from_another_process():
    """Position, attitude xyzw and stamp of each kind of message; of TF the one transform that is
    named.
    """
    names = (
        ("vehicle", f"{KINDS[0]}:/quad/pose"),
        ("payload", f"{KINDS[1]}:/ball/odom"),
        ("goal", f"{KINDS[2]}:/tf:world/goal"),
    )
    bodies = tuple(RigidBody(body, name) for body, name in names)
    source = Ros2Source(
        MocapParams("ros2", "127.0.0.1", settings={"domain": DOMAIN}), bodies, time.monotonic
    )
    other = subprocess.Popen([sys.executable, "-c", PUBLISHER, DOMAIN])
    poses, end = {}, time.monotonic() + 20.0
    try:
        while len(poses) < 3 and time.monotonic() < end and other.poll() is None:
            for pose in source.poll(time.monotonic()):
                poses.setdefault(pose.body, pose)
            time.sleep(0.01)
    finally:
        other.kill()
        other.wait()
        source.close()
    assert set(poses) == {"vehicle", "payload", "goal"}
    for body, first in (("vehicle", 1.0), ("payload", 1.0), ("goal", 5.0)):
        pose = poses[body]
        n = round(pose.stamp - 1000.25)
        assert pose.stamp == 1000.25 + n
        assert pose.pos[0] == first + n
        assert pose.quat == (0.0, 0.0, 0.6, 0.8)
        assert 0.0 < time.monotonic() - pose.arrival < 20.0


@mark.parametrize(
    "name", ["quad", "geometry_msgs/Pose:/quad", "tf2_msgs/TFMessage:/tf", "nav_msgs/Odometry:quad"]
)
def test_names_that_are_no_topic_are_refused(name):
    with raises(SourceError, match="expected TYPE:TOPIC with a type of"):
        Ros2Source(
            MocapParams("ros2", "127.0.0.1", settings={"domain": DOMAIN}),
            (RigidBody("vehicle", name),),
            time.monotonic,
        )


def test_a_domain_that_is_none_is_refused():
    quad = (RigidBody("vehicle", f"{KINDS[0]}:/quad"),)
    with raises(SourceError, match="expected ROS_DOMAIN_ID, 0 to 232"):
        Ros2Source(
            MocapParams("ros2", "127.0.0.1", settings={"domain": "ros"}), quad, time.monotonic
        )
