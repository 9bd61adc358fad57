"""Choose the compute device and the precision of its products."""

from collections.abc import Iterator
from contextlib import contextmanager

from visthrow.common.errors import DeviceError


def resolve(name: str = "auto") -> str:
    """Resolve ``auto`` (a CUDA device if there is one), ``cpu``, ``cuda`` or ``cuda:<i>`` to
    ``cpu`` or ``cuda:<i>``, a device that torch can use.

    Raises DeviceError: there is no such device.
    """
    import torch

    return _choose_device(name, torch.cuda.device_count() if torch.cuda.is_available() else 0)


def resolve_for_warp(name: str = "auto") -> str:
    """Resolve a name as :func:`resolve` does, to a device that Warp can use.

    It does not load torch, which takes seconds, for commands that only simulate. Raises
    DeviceError: there is no such device."""
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
def allow_rounded_products(allowed: bool) -> Iterator[None]:
    """Allow or forbid TF32, with a mantissa of ten bits, for float32 products on a GPU in a
    context: it suffices for networks but not for rays of keypoints.

    A CUDA graph keeps the setting under which it was captured.
    """
    import torch

    previous = torch.backends.cuda.matmul.allow_tf32
    torch.backends.cuda.matmul.allow_tf32 = allowed
    try:
        yield
    finally:
        torch.backends.cuda.matmul.allow_tf32 = previous
