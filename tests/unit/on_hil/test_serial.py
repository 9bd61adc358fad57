"""MSP on a serial port (a pseudo-terminal), and its recording."""

import os
import sys
import time
import tty

from pytest import fixture, importorskip, raises

from hil.errors import LinkError
from hil.links.device import Device, SerialPort
from hil.links.writer import HEAD, LoggedPort
from visthrow.common.errors import StorageError


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


def test_a_missing_port_is_named_once():
    importorskip("serial")
    with raises(LinkError) as caught:
        SerialPort(Device("serial", "/dev/no_such_port", 115200))
    assert str(caught.value).startswith(
        "cannot open /dev/no_such_port: No such file or directory; plugged in here: "
    )
    assert str(caught.value).count("no_such_port") == 1


def test_a_missing_package_is_named_as_it_is_installed(monkeypatch):
    """Of pyserial, which is imported as ``serial``."""
    monkeypatch.setitem(sys.modules, "serial", None)
    with raises(LinkError, match=r"package 'pyserial'; .* 'visthrow\[serial\]'"):
        SerialPort(Device("serial", "/dev/ttyACM0", 115200))
