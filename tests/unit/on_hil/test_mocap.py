"""Motion-capture packages: stand-ins with the packages' own faces, and these faces against the
packages where they are.
"""

import importlib
import socket
import sys
import threading
import time
from dataclasses import replace
from types import SimpleNamespace

from pytest import fixture, mark, raises

from bench.processes import free_port
from hil.errors import LinkError, SourceError
from hil.poses.sources.motion_capture import (
    MocapParams,
    MotionCaptureSource,
    NatNetSource,
    RigidBody,
)
from hil.poses.sources.open_source import open_mocap
from tests.waiting import eventually

BODIES = (RigidBody("vehicle", "quad"), RigidBody("payload", "ball"))
PARAMS = MocapParams("vicon", "127.0.0.1", timeout=1.0)


def body(x, y=0.0):
    """As motioncapture.RigidBody; its position is an array, its rotation has x, y, z, w."""
    return SimpleNamespace(
        name="", position=[x, y, 1.0], rotation=SimpleNamespace(x=0.1, y=0.2, z=0.3, w=0.9)
    )


class System:
    """As motioncapture.MotionCapture: frames come when the test says so."""

    def __init__(self, frames):
        self._frames, self.rigidBodies, self.next = iter(frames), {}, threading.Semaphore(0)

    def waitForNextFrame(self):
        self.next.acquire()
        self.rigidBodies = next(self._frames)


def test_rigid_bodies_by_name_from_a_separate_thread():
    frames = [{"quad": body(1.0), "other": body(9.0)}, {"ball": body(2.0), "quad": body(1.5)}]
    system, connections, now = System(frames), [], [5.0]
    module = SimpleNamespace(connect=lambda *args: connections.append(args) or system)
    params = MocapParams("qualisys", "127.0.0.1", settings={"port": "22223"})
    source = MotionCaptureSource(params, BODIES, lambda: now[0], module=module)
    assert connections == [("qualisys", {"hostname": "127.0.0.1", "port": "22223"})]
    assert source.poll(0.0) == [], "polling never waits"
    system.next.release()
    eventually(lambda: source._waiting)
    now[0] = 6.0
    system.next.release()
    eventually(lambda: len(source._waiting) == 3)
    first, *second = source.poll(0.0)
    assert (first.body, first.pos, first.quat) == ("vehicle", (1.0, 0.0, 1.0), (0.1, 0.2, 0.3, 0.9))
    assert first.stamp == first.arrival == 5.0
    assert [(pose.body, pose.arrival) for pose in second] == [("payload", 6.0), ("vehicle", 6.0)]
    source.close()


def test_a_frame_that_raises_is_dropped_and_counted():
    """A body that is occluded, as libmotioncapture's Vicon raises it (its issue 9), and a position
    of two numbers: the other body goes on.
    """

    class Occluded:
        @property
        def position(self):
            raise RuntimeError("occluded")

    short = SimpleNamespace(position=[1.0, 2.0], rotation=body(0.0).rotation)
    frames = [{"quad": Occluded(), "ball": body(1.0)}, {"quad": short, "ball": body(2.0)}]
    system, messages = System(frames), []
    module = SimpleNamespace(connect=lambda *args: system)
    source = MotionCaptureSource(PARAMS, BODIES, lambda: 1.0, module=module, tell=messages.append)
    for _ in range(5):  # two frames, and three that the package does not have: it raises
        system.next.release()
    eventually(lambda: source.roster.refused == 5)
    assert [(p.body, p.pos[0]) for p in source.poll(0.0)] == [("payload", 1.0), ("payload", 2.0)]
    assert source.failure is None
    assert len(messages) == 3, "each kind once"
    assert "body quad from 127.0.0.1: RuntimeError: occluded" in messages[0]
    assert "frame from 127.0.0.1: StopIteration" in messages[2]
    source.close()


CRASHES = """
import os, time
from types import SimpleNamespace as N
class System:
    n = 0
    def waitForNextFrame(self):
        time.sleep(0.005)
        self.n += 1
        if self.n == 20:
            os.abort()  # as a parser in C++ that reads beyond the end of a datagram
    @property
    def rigidBodies(self):
        turn = N(x=0.0, y=0.0, z=0.0, w=1.0)
        return {"quad": N(position=[0.01 * self.n, 0.0, 1.0], rotation=turn)}
def connect(*args):
    print("what the package prints")
    return System()
"""


@fixture
def package(tmp_path, monkeypatch):
    """Writes a stand-in of motioncapture for other processes."""
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.setenv("PYTHONPATH", str(tmp_path))
    importlib.invalidate_caches()
    return (tmp_path / "motioncapture.py").write_text


def test_a_package_that_crashes_is_started_again_on_the_ground_alone(package, monkeypatch):
    package(CRASHES)
    monkeypatch.setattr("hil.poses.sources.motion_capture.RESTART_DELAY", 0.05)
    messages = []
    patient = replace(PARAMS, timeout=30.0)
    source = MotionCaptureSource(patient, BODIES, time.monotonic, tell=messages.append)
    source.hold(True)
    eventually(lambda: source.failure is not None)
    assert len(source.poll(0.0)) == 19
    assert messages == [
        "motion capture stopped: SourceError: its process ended with -6; it is started again on the"
        " ground"
    ]
    time.sleep(0.5)
    assert source.poll(0.0) == [], "not in flight"
    source.hold(False)
    eventually(lambda: source.failure is None)
    eventually(lambda: source.poll(0.0))
    assert messages[1] == "motion capture is connected again"
    source.close()


HEARS_ANYBODY = """
import socket
from types import SimpleNamespace as N
class System:
    def __init__(self, options):
        self.socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self.socket.bind(("127.0.0.1", int(options["port"])))
        self.rigidBodies = {}
    def waitForNextFrame(self):
        x = float(self.socket.recv(100))
        turn = N(x=0.0, y=0.0, z=0.0, w=1.0)
        self.rigidBodies = {"quad": N(position=[x, 0.0, 1.0], rotation=turn)}
def connect(kind, options):
    return System(options)
"""


@mark.skipif(sys.platform != "linux", reason="the filter is Linux's")
def test_the_package_hears_the_host_alone(package):
    """Whatever sockets it opens, other senders' datagrams do not get to them, and are counted."""
    package(HEARS_ANYBODY)
    port, messages = free_port(), []
    params = replace(PARAMS, timeout=30.0, settings={"port": str(port)})
    source = MotionCaptureSource(params, BODIES, time.monotonic, tell=messages.append)
    senders = {}
    for host in ("127.0.0.1", "127.0.0.2"):
        senders[host] = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        senders[host].bind((host, 0))
    taken, deadline = [], time.monotonic() + 30.0
    while len(taken) < 20 or not source.roster.refused:
        assert time.monotonic() < deadline
        senders["127.0.0.2"].sendto(b"9.0", ("127.0.0.1", port))
        senders["127.0.0.1"].sendto(b"1.0", ("127.0.0.1", port))
        time.sleep(0.05)
        taken += [pose.pos[0] for pose in source.poll(0.0)]
    assert set(taken[1:]) == {1.0}, "the first may come before the filter"
    assert "datagram from others: source.mocap.host is 127.0.0.1" in messages[0]
    for one in senders.values():
        one.close()
    source.close()


BLOCKS = """
import ctypes
def connect(kind, options):
    assert (kind, options["hostname"]) == ("vicon", "127.0.0.1")
    ctypes.PyDLL(None).sleep(60)  # holds the interpreter, as the package does
"""


def test_a_package_that_holds_the_interpreter_holds_nothing_up(package):
    package(BLOCKS)
    begin = time.monotonic()
    with raises(SourceError, match=r"vicon at 127.0.0.1: no answer within 1 s"):
        MotionCaptureSource(PARAMS, BODIES, time.monotonic)
    assert time.monotonic() - begin < 30.0
    package("def connect(*args):\n    raise RuntimeError('no such host')\n")
    with raises(SourceError, match="RuntimeError: no such host"):
        MotionCaptureSource(replace(PARAMS, timeout=60.0), BODIES, time.monotonic)


IDS = (RigidBody("vehicle", "7"), RigidBody("payload", "8"))


class DeafClient:
    """As natnet.NatNetClient, without a server."""

    def __init__(self, **options):
        self.on_data_frame_received_event = SimpleNamespace(handlers=[])

    def connect(self, timeout=5.0):
        raise TimeoutError

    def shutdown(self):
        pass


def test_natnet_that_does_not_answer():
    module = SimpleNamespace(NatNetClient=DeafClient)
    with raises(SourceError, match=r"natnet at 127.0.0.1 .*multicast\): no answer within 1 s"):
        NatNetSource(
            MocapParams("natnet", "127.0.0.1", timeout=1.0), IDS, time.monotonic, module=module
        )
    with raises(SourceError, match="natnet bodies quad, ball; expected streaming ids"):
        NatNetSource(MocapParams("natnet", "127.0.0.1"), BODIES, time.monotonic, module=module)


def test_wrong_names_hosts_and_missing_packages(monkeypatch):
    with raises(SourceError, match="expected each body once"):
        open_mocap(PARAMS, (BODIES[0], RigidBody("payload", "quad")), time.monotonic, False)
    with raises(LinkError, match="is on another machine; set link"):
        open_mocap(MocapParams("vicon", "192.168.1.9"), BODIES, time.monotonic, False)
    with raises(LinkError, match="refused"):
        open_mocap(MocapParams("vicon", "vicon.local"), BODIES, time.monotonic, True)
    for system, package, bodies in (("vicon", "motioncapture", BODIES), ("natnet", "natnet", IDS)):
        monkeypatch.setitem(__import__("sys").modules, package, None)
        with raises(SourceError, match=rf"pip install 'visthrow\[{package}\]'"):
            open_mocap(MocapParams(system, "127.0.0.1"), bodies, time.monotonic, False)


def test_a_motion_capture_on_another_machine_needs_the_configs_leave(monkeypatch):
    source = "hil.poses.sources.open_source.MotionCaptureSource"
    monkeypatch.setattr(source, lambda params, *args, **options: params.host)
    params = MocapParams("vicon", "192.0.2.1", timeout=1.0)
    assert open_mocap(params, IDS, time.monotonic, True) == "192.0.2.1"
    with raises(LinkError, match="remote"):
        open_mocap(params, IDS, time.monotonic, False)
