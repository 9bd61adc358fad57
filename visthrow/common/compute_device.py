"""Choice of the compute device, and how exact its products are."""

from collections.abc import Iterator
from contextlib import contextmanager

from visthrow.common.errors import DeviceError


def resolve(name: str = "auto") -> str:
    """Turn ``auto`` (a CUDA device if there is one), ``cpu``, ``cuda`` or ``cuda:<i>`` into ``cpu``
    or ``cuda:<i>``, a device that torch can use.

    Raises DeviceError if there is no such device.
    """
    import torch

    return _choose_device(name, torch.cuda.device_count() if torch.cuda.is_available() else 0)


def resolve_for_warp(name: str = "auto") -> str:
    """Resolve a name as :func:`resolve` does, to a device that Warp can use.

    For what only simulates: it does not load torch, which takes seconds. Raises DeviceError if
    there is no such device."""
    import warp as wp

    from camera.warp_start import start

    start()
    return _choose_device(name, wp.get_cuda_device_count())


def _choose_device(name: str, count: int) -> str:
    exists = ["cpu", *(f"cuda:{i}" for i in range(count))]
    device = {"auto": exists[1] if count else "cpu", "cuda": "cuda:0"}.get(name, name)
    if device not in exists:
        raise DeviceError(f"no device '{name}'; expected auto or one of {', '.join(exists)}")
    return device


@contextmanager
def rounded_products(allowed: bool) -> Iterator[None]:
    """Allow or forbid TF32's ten bits in float32 products on a GPU while the context lasts:
    networks tolerate them, rays of keypoints do not.

    A CUDA graph keeps what held when it was captured.
    """
    import torch

    previous = torch.backends.cuda.matmul.allow_tf32
    torch.backends.cuda.matmul.allow_tf32 = allowed
    try:
        yield
    finally:
        torch.backends.cuda.matmul.allow_tf32 = previous
