"""Serve rerun's web viewer to this machine only. Onboard-safe."""

import socket
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any
from urllib.parse import quote

from visthrow.common.errors import DeviceError

HOST = "127.0.0.1"
# ports of the viewer's page and of its data
WEB_PORT = 9090
DATA_PORT = 9876


@contextmanager
def web_viewer(layout: Any, web_port: int, data_port: int) -> Iterator[Any]:
    """Serve the viewer with one recording and print its address; yields the recording's stream.

    Raises DeviceError: the viewer did not start, as with a port in use.
    """
    import rerun as rr

    command = [
        sys.executable,
        "-m",
        "rerun",
        "--serve-web",
        "--bind",
        HOST,
        "--port",
        str(data_port),
    ]
    command += ["--web-viewer-port", str(web_port), "--server-memory-limit", "500MB"]
    server = subprocess.Popen(
        command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL, stdin=subprocess.DEVNULL
    )
    data = f"rerun+http://{HOST}:{data_port}/proxy"
    try:
        if not _answers(server, web_port):
            raise DeviceError(
                f"the viewer did not start; expected free ports {web_port} and {data_port}, or give"
                " others"
            )
        print(
            f"look at http://{HOST}:{web_port}?url={quote(data, safe='')}",
            file=sys.stderr,
            flush=True,
        )
        stream = rr.RecordingStream("visthrow", recording_id=None)
        stream.connect_grpc(data, default_blueprint=layout)
        yield stream
        stream.flush()
    finally:
        server.terminate()
        server.wait(5)


def _answers(server: subprocess.Popen, port: int) -> bool:
    """Return whether the server that we started listens on a port within half a minute."""
    for _ in range(300):
        time.sleep(0.1)
        if server.poll() is not None:
            return False
        with socket.socket() as probe:
            if probe.connect_ex((HOST, port)) == 0:
                return True
    return False
