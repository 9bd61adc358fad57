"""MSP on a serial port (a pseudo-terminal), and what is written down of it."""

import os
import struct
import time
import tty

from pytest import fixture, importorskip, raises

from hil.errors import LinkError
from hil.links import msp
from hil.links.backends.betaflight import Betaflight
from hil.links.device import Device, SerialPort
from hil.links.writer import HEAD, LoggedPort
from tests.configs import load_run
from tests.waiting import eventually
from visthrow.common.errors import StorageError

PARAMS = load_run("fake_betaflight", ["betaflight.audit=false"]).betaflight
STATUS = struct.pack("<HHHIBHHBBI", 125, 0, 33, 1, 0, 10, 0, 0, 29, 0)


@fixture
def wire():
    """The flight controller's end of a line, and a port at the other."""
    importorskip("serial")
    controller, line = os.openpty()
    tty.setraw(controller)
    tty.setraw(line)
    os.set_blocking(controller, False)
    port = SerialPort(Device("serial", os.ttyname(line), 115200))
    yield controller, port
    port.close()
    os.close(controller)
    os.close(line)


def asked(controller, command):
    """Wait until a command comes to the flight controller."""
    parser = msp.FrameParser()

    def came():
        try:
            return any(f.command == command for f in parser.parse(os.read(controller, 65536)))
        except BlockingIOError:
            return False

    eventually(came)


def serve(backend, now):
    """For a while, at one time of the runner's: a pseudo-terminal hands on in pieces."""
    for _ in range(20):
        backend.service(now)
        time.sleep(0.01)


def test_a_back_end_on_a_serial_port(wire):
    controller, port = wire
    backend = Betaflight(port, PARAMS)
    assert port.read() is None, "reading never waits"
    backend.service(0.0)
    asked(controller, msp.STATUS)
    assert not backend.status(0.1).connected
    answer = msp.pack(msp.Frame(msp.STATUS, STATUS, msp.ANSWER))
    os.write(controller, answer[:7])
    serve(backend, 0.2)
    os.write(
        controller, answer[7:] + msp.pack(msp.Frame(msp.BOXIDS, bytes([0, 1, 27, 50]), msp.ANSWER))
    )
    serve(backend, 0.3)
    assert not backend.send((2.668, 0.0, 0.0, 0.0), 0.3), (
        "the order of the channels is not known yet"
    )
    assert not backend.status(0.3).connected
    os.write(
        controller, msp.pack(msp.Frame(msp.RX_MAP, bytes([0, 1, 3, 2, 4, 5, 6, 7]), msp.ANSWER))
    )
    serve(backend, 0.35)
    assert backend.status(0.35).connected
    backend.ask("follow", 0.4)
    assert backend.send((2.668, 0.0, 0.0, 0.0), 0.4)
    asked(controller, msp.SET_RAW_RC)


def read_log(path):
    """Direction and bytes of each chunk."""
    data = path.read_bytes()
    while data:
        _, direction, count = HEAD.unpack_from(data)
        yield direction, data[HEAD.size : HEAD.size + count]
        data = data[HEAD.size + count :]


def test_what_went_over_the_port_is_written_down(wire, tmp_path):
    controller, port = wire
    logged = LoggedPort(port, tmp_path / "run" / "link.msp")
    logged.write(b"abc")
    os.write(controller, b"defg")
    heard, end = b"", time.monotonic() + 30.0
    while len(heard) < 4 and time.monotonic() < end:
        heard += logged.read() or b""
    assert heard == b"defg"
    assert logged.read() is None
    assert logged.fileno() == port.fileno()
    logged.close()
    path = tmp_path / "run" / "link.msp"
    chunks = [(way, data) for way, data in read_log(path)]
    assert chunks[0] == (b"<", b"abc")
    assert b"".join(data for way, data in chunks if way == b">") == b"defg", (
        "in pieces, as they came"
    )
    with raises(StorageError, match="cannot write"):
        LoggedPort(port, tmp_path)


def test_a_full_disk_troubles_nobody(wire, tmp_path):
    _, port = wire
    logged = LoggedPort(port, tmp_path / "link.msp")
    logged.log._file.close()
    assert logged.write(b"abc")
    logged.close()
    assert logged.log.failed == 1


def test_a_port_that_is_not_there_is_named_once():
    importorskip("serial")
    with raises(LinkError) as caught:
        SerialPort(Device("serial", "/dev/no_such_port", 115200))
    assert str(caught.value).startswith(
        "cannot open /dev/no_such_port: No such file or directory; plugged in here: "
    )
    assert str(caught.value).count("no_such_port") == 1
