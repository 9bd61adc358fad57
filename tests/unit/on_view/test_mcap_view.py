"""A flight as MCAP, read back by the library's own reader; throws on another rope by allowance;
tables beside it.
"""

import json
import sys
from unittest import mock

from numpy.testing import assert_allclose, assert_array_equal
from pytest import fixture, importorskip

from tests.commands import run_command
from visthrow.logs.flightlog import FlightLog
from visthrow.view import mcap_view

reader = importorskip("mcap.reader")

SELDOM = 1.0
"""Between two pictures of the image plane [s]."""


@fixture(scope="module")
def flown(tmp_path_factory):
    """Folder of one throw, exported to all formats."""
    folder = tmp_path_factory.mktemp("flown")
    exports = [
        word
        for ending in ("mcap", "parquet", "csv")
        for word in ("--export", str(folder / f"flight.{ending}"))
    ]
    with mock.patch.object(mcap_view, "IMAGE_PERIOD", SELDOM):
        assert run_command(f"fly --device cpu --out {folder} --target 1.5", *exports) == 0
    return folder


def messages(folder, topic: str) -> list[tuple[str, int, dict]]:
    """Schema, log time [ns] and content of a topic's messages."""
    with (folder / "flight.mcap").open("rb") as file:
        iterator = reader.make_reader(file).iter_messages(topics=[topic])
        return [
            (schema.name, message.log_time, json.loads(message.data))
            for schema, _, message in iterator
        ]


def test_poses_and_commands_read_back_as_they_were_flown(flown):
    log = FlightLog.load(flown / "flight.npz")
    begin = min(channel.time[0] for channel in log.channels.values())
    moved = messages(flown, "/tf")
    assert {name for name, _, _ in moved} == {"foxglove.FrameTransform"}
    places = [[content["translation"][axis] for axis in "xyz"] for _, _, content in moved]
    assert_array_equal(places, log["pos_w"].values)
    assert_allclose([1e-9 * stamp for _, stamp, _ in moved], log["pos_w"].time - begin, atol=1e-9)
    turned = [[content["rotation"][axis] for axis in "xyzw"] for _, _, content in moved]
    assert_array_equal(turned, log["quat_wb"].values)
    sent = [
        [c["thrust_n"], c["rate_x"], c["rate_y"], c["rate_z"]]
        for _, _, c in messages(flown, "/command")
    ]
    assert_array_equal(sent, log["command"].values)


def test_every_channel_exists_with_its_unit_and_schema(flown):
    log = FlightLog.load(flown / "flight.npz")
    with (flown / "flight.mcap").open("rb") as file:
        summary = reader.make_reader(file).get_summary()
        file.seek(0)
        about = {
            record.name: record.metadata for record in reader.make_reader(file).iter_metadata()
        }
    topics = {channel.topic: channel for channel in summary.channels.values()}
    assert {f"/signals/{name}" for name in log.channels} <= set(topics)
    assert topics["/signals/pos_w"].metadata == {"unit": "m", "frame": "world"}
    for schema in summary.schemas.values():
        assert schema.encoding == "jsonschema"
        assert json.loads(schema.data)["type"] == "object"
    assert json.loads(about["flight"]["policy"]) == "vision"


def test_tables_beside_it_and_an_ending_that_no_writer_has(flown, tmp_path, refused):
    assert (flown / "flight.csv").read_text().startswith("time [s],")
    assert (flown / "flight.parquet").stat().st_size > 0
    refused(
        f"fly --out {tmp_path} --export flight.xyz",
        message="'.xyz'; expected one of .csv, .parquet, .mcap",
    )


def test_fly_refuses_a_switch_that_would_change_nothing(tmp_path, refused):
    refused(
        f"fly --out {tmp_path} --set task.noise.command_step=0",
        message="fly sends commands as they are",
    )


def test_a_missing_package_is_named_before_the_flight(tmp_path, monkeypatch, refused):
    monkeypatch.setitem(sys.modules, "mcap.writer", None)
    folder = tmp_path / "flown"
    refused(f"fly --out {folder} --export {tmp_path}/flight.mcap", message="visthrow[recordings]")
    assert not folder.exists()
