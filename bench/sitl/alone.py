"""Run a command in a network of its own, loopback alone: a firmware in software listens on every
address it finds.

    python bench/sitl/alone.py COMMAND ...

Where the system grants no network namespace it prints a warning and runs the command on this
machine's network."""

import ctypes
import fcntl
import os
import socket
import struct
import sys

CLONE_NEWUSER = 0x10000000
CLONE_NEWNET = 0x40000000
SIOCGIFFLAGS = 0x8913
SIOCSIFFLAGS = 0x8914
IFF_UP = 1


def leave() -> bool:
    """Whether this process has a network of its own now."""
    libc = ctypes.CDLL(None, use_errno=True)
    return libc.unshare(CLONE_NEWNET) == 0 or libc.unshare(CLONE_NEWUSER | CLONE_NEWNET) == 0


def raise_loopback() -> None:
    """Bring the loopback interface up: in a new network it is down."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as any_socket:
        request = struct.pack("16sh14x", b"lo", 0)
        flags = struct.unpack("16sh14x", fcntl.ioctl(any_socket, SIOCGIFFLAGS, request))[1]
        fcntl.ioctl(any_socket, SIOCSIFFLAGS, struct.pack("16sh14x", b"lo", flags | IFF_UP))


if __name__ == "__main__":
    if leave():
        raise_loopback()
        print("the firmware has a network of its own", flush=True)
    else:
        print(
            "no network namespace is granted: the firmware listens on all of this machine's"
            " addresses",
            flush=True,
        )
    os.execvp(sys.argv[1], sys.argv[1:])
