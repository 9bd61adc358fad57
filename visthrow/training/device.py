"""Choice of the compute device."""

from sim.arrays.cores import cores as cores
from visthrow.common.errors import DeviceError


def resolve(name: str = "auto") -> str:
    """Turn what the user wrote into a device that is there.

    Args:
        name: ``auto`` (a CUDA device if there is one, else the CPU), ``cpu``, ``cuda`` or ``cuda:<i>``.

    Returns:
        ``cpu`` or ``cuda:<i>``, as torch and Warp both understand it.

    Raises:
        DeviceError: If there is no such device.
    """
    import torch

    count = torch.cuda.device_count() if torch.cuda.is_available() else 0
    exists = ["cpu", *(f"cuda:{i}" for i in range(count))]
    wanted = {"auto": exists[1] if count else "cpu", "cuda": "cuda:0"}.get(name, name)
    if wanted not in exists:
        raise DeviceError(f"device '{name}' is not there; expected auto or one of {', '.join(exists)}")
    return wanted


def device_name(device: str) -> str:
    """Return the model of the processor that a device is."""
    if not device.startswith("cuda"):
        return "CPU"
    import torch

    return torch.cuda.get_device_name(device)
