"""Recordings of other tools: written by the formats' own writers, or byte by byte; read, mapped,
checked.
"""

import json
import struct
import zlib
from pathlib import Path

import numpy as np
from pytest import approx, importorskip, mark, raises

from tests.flightlogs import flight
from visthrow.common.errors import LogError
from visthrow.diagnose.inputs.proposal import propose
from visthrow.logs import read, table_of

COLUMNS = flight(8.0)
TIME = COLUMNS["time"]


def card(path: Path, version: int) -> None:
    """A Crazyflie's card: two events with clocks of their own."""
    events = {
        0: ("fixedFrequency", ["acc.x", "acc.y", "acc.z"]),
        7: ("estPosition", ["x", "y", "z"]),
    }
    data = bytes([0xBC]) + struct.pack("<HH", version, len(events))
    for number, (name, fields) in events.items():
        data += struct.pack("<H", number) + name.encode() + b"\x00" + struct.pack("<H", len(fields))
        data += b"".join(f"{field}(f)".encode() + b"\x00" for field in fields)
    for i, t in enumerate(TIME):
        stamp = (
            struct.pack("<I", round(1e3 * t) + 5000)
            if version == 1
            else struct.pack("<Q", round(1e6 * t) + 5_000_000)
        )
        data += struct.pack("<H", 0) + stamp + struct.pack("<fff", *COLUMNS["acc_b"][i] / 9.80665)
        if i % 2:
            data += struct.pack("<H", 7) + stamp + struct.pack("<fff", *COLUMNS["pos_w"][i])
    path.write_bytes(data + struct.pack("<I", zlib.crc32(data)))


def hdf5(path: Path) -> None:
    h5py = importorskip("h5py")
    with h5py.File(path, "w") as file:
        file["time"], file["drone/pos"], file["imu/acc"] = (
            TIME,
            COLUMNS["pos_w"],
            COLUMNS["acc_b"].T,
        )


def matlab(path: Path) -> None:
    from scipy.io import savemat

    savemat(
        path,
        {
            "time": TIME,
            "drone": {"pos": COLUMNS["pos_w"]},
            "imu": np.array([{"acc": COLUMNS["acc_b"]}, {"count": TIME}], dtype=object),
            "note": "a flight",
        },
    )


def write_mcap(path: Path, topics: dict[str, str], messages: list[tuple[str, int, bytes]]) -> None:
    """Write messages (topic, stamp [ns], data) of topics with an encoding each."""
    writer_of = importorskip("mcap.writer")
    with path.open("wb") as file:
        writer = writer_of.Writer(file)
        writer.start()
        schema = writer.register_schema(name="any", encoding="jsonschema", data=b"{}")
        numbers = {
            name: writer.register_channel(f"/{name}", encoding, schema)
            for name, encoding in topics.items()
        }
        for name, stamp, data in messages:
            writer.add_message(numbers[name], stamp, data, stamp)
        writer.finish()


def mcap(path: Path) -> None:
    messages = []
    for i, t in enumerate(TIME):
        stamp = round(1e9 * t) + 1_700_000_000_000_000_000
        for name, value in (
            ("pose", {"position": dict(zip("xyz", COLUMNS["pos_w"][i]))}),
            ("imu", {"acc": dict(zip("xyz", COLUMNS["acc_b"][i]))}),
        ):
            if name == "imu" or i % 2:
                messages.append((name, stamp, json.dumps(value).encode()))
    write_mcap(path, {"pose": "json", "imu": "json"}, messages)


@mark.parametrize("others", [["protobuf"], ["cbor", "protobuf"], []])
def test_topics_that_cannot_be_decoded_are_named_and_the_rest_is_read(others, tmp_path):
    path = tmp_path / "a.mcap"
    messages = [("json", i, json.dumps({"values": [i, 2 * i]}).encode()) for i in range(60)]
    messages += [(other, i, b"\xff") for other in others for i in range(60)]
    write_mcap(path, {name: name for name in ("json", *others)}, messages)
    table = table_of(path)
    assert table["json:values[1]"].tolist() == [2.0 * i for i in range(60)]
    assert len(table.left_out) == len(others)
    assert all(any(other in part for part in table.left_out) for other in others)


def bag(path: Path, ros: int = 1) -> None:
    """A bag of poses and of an IMU."""
    module = importorskip(f"rosbags.rosbag{ros}")
    from rosbags.typesys import Stores, get_typestore

    store = get_typestore(Stores.ROS1_NOETIC if ros == 1 else Stores.ROS2_HUMBLE)
    writer_of = module.Writer(path) if ros == 1 else module.Writer(path.with_suffix(""), version=8)
    pose, imu = "geometry_msgs/msg/PoseStamped", "sensor_msgs/msg/Imu"
    with writer_of as writer:
        topics = {
            kind: writer.add_connection(topic, kind, typestore=store)
            for topic, kind in (("/drone/pose", pose), ("/imu", imu))
        }
        for i, t in enumerate(TIME):
            pack = store.serialize_ros1 if ros == 1 else store.serialize_cdr
            for kind, message in zip((pose, imu), messages(store, ros, i, t)):
                writer.write(
                    topics[kind],
                    1_000_000_000_000 + round(1e9 * t) + 3_000_000,
                    pack(message, kind),
                )
    if ros == 2:
        (made,) = path.with_suffix("").glob("*.db3")
        path.with_suffix("").joinpath("metadata.yaml").rename(path.parent / "metadata.yaml")
        made.rename(path.parent / made.name)


def messages(store, ros: int, i: int, t: float) -> tuple:
    """A pose and an IMU's message of one instant."""
    types = store.types
    vector, point, turn = (
        types[f"geometry_msgs/msg/{n}"] for n in ("Vector3", "Point", "Quaternion")
    )
    stamp = types["builtin_interfaces/msg/Time"](1000 + int(t), round(1e9 * (t % 1.0)))
    head = types["std_msgs/msg/Header"](*([i] if ros == 1 else []), stamp, "world")
    attitude = turn(*COLUMNS["quat_wb"][i])
    forces = vector(*COLUMNS["rate_b"][i]), np.zeros(9), vector(*COLUMNS["acc_b"][i]), np.zeros(9)
    placed = types["geometry_msgs/msg/Pose"](point(*COLUMNS["pos_w"][i]), attitude)
    return types["geometry_msgs/msg/PoseStamped"](head, placed), types["sensor_msgs/msg/Imu"](
        head, attitude, np.zeros(9), *forces
    )


WRITERS = {
    "log00": lambda p: card(p, 2),
    "log01": lambda p: card(p, 1),
    "a.h5": hdf5,
    "a.mat": matlab,
    "a.mcap": mcap,
    "a.bag": bag,
    "a.db3": lambda p: bag(p, 2),
}


def folder(path: Path) -> None:
    """A table for each topic, whose names begin alike, and a file that is no table."""
    path.mkdir()
    (path / "run3_notes.txt").write_text("none")
    (path / "run3_events.csv").write_text("number,kind\n" + "".join(f"{i},1\n" for i in range(99)))
    for topic, name in (("pose", "pos_w"), ("imu", "acc_b")):
        rows = np.column_stack([1e9 * TIME, COLUMNS[name]])
        head = f"stamp,{name}.x,{name}.y,{name}.z"
        np.savetxt(path / f"run3_{topic}.csv", rows, "%.9g", ",", header=head, comments="")


@mark.parametrize("name", [*WRITERS, "flight"])
def test_positions_and_forces_come_out_as_they_went_in(name, tmp_path):
    path = tmp_path / name
    WRITERS.get(name, folder)(path)
    proposal = propose(table_of(path), name)
    (log,) = read(path, proposal.mapping)
    assert {"pos_w", "acc_b"} <= set(log.channels)
    every = 2 if name in ("log00", "log01", "a.mcap") else 1
    assert log["pos_w"].values == approx(
        COLUMNS["pos_w"][1::2] if every == 2 else COLUMNS["pos_w"], abs=1e-5
    )
    assert log["acc_b"].values == approx(COLUMNS["acc_b"], abs=1e-4)
    assert np.median(np.diff(log["pos_w"].time)) == approx(0.01 * every, rel=1e-3)
    assert (proposal.mapping.clocks is not None) == (name not in ("a.h5", "a.mat")), (
        "tables with clocks of their own"
    )
    assert not any("events:" in question for question in proposal.questions)
    with raises(LogError, match="needs a mapping"):
        read(path)


@mark.parametrize("name", WRITERS)
def test_damage_is_reported(name, tmp_path):
    path = tmp_path / name
    WRITERS[name](path)
    path.write_bytes(path.read_bytes()[:300])
    with raises(LogError, match=path.name):
        table_of(path)


@mark.parametrize("version", [1, 2])
def test_a_spoilt_byte_of_a_card_is_noticed_by_its_checksum(version, tmp_path):
    path = tmp_path / "log00"
    card(path, version)
    data = bytearray(path.read_bytes())
    data[-10] ^= 1
    path.write_bytes(data)
    with raises(LogError, match="its checksum is wrong"):
        table_of(path)
