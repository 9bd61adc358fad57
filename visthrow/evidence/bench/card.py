"""Peak numbers of GPUs: single-precision arithmetic and memory bandwidth."""

from dataclasses import dataclass


@dataclass(frozen=True)
class Peaks:
    """What a card can do at most."""

    name: str
    flops: float  # single precision, a fused multiply-add counts two [1/s]
    bandwidth: float  # of its memory [B/s]
    source: str


KNOWN = {
    "H200": (67e12, 4.8e12, "NVIDIA H200 data sheet, SXM: 67 TFLOP/s FP32, 4.8 TB/s"),
    "H100": (67e12, 3.35e12, "NVIDIA H100 data sheet, SXM: 67 TFLOP/s FP32, 3.35 TB/s"),
    "A100": (19.5e12, 2.039e12, "NVIDIA A100 data sheet, SXM 80 GB: 19.5 TFLOP/s FP32, 2,039 GB/s"),
    "RTX 4090": (82.6e12, 1.008e12, "NVIDIA Ada whitepaper: 82.6 TFLOP/s FP32, 1,008 GB/s"),
}
LANES = 128
"""Single-precision lanes of a multiprocessor since compute capability 8.6 (CUDA C++ Programming Guide)."""


def peaks(device: str) -> Peaks | None:
    """Peaks of a device: from the table, else from its properties; None for the CPU."""
    if not device.startswith("cuda"):
        return None
    import torch

    p = torch.cuda.get_device_properties(device)
    for key, numbers in KNOWN.items():
        if key in p.name:
            return Peaks(p.name, *numbers)
    clock, memory, width = (getattr(p, key, None) for key in ("clock_rate", "memory_clock_rate", "memory_bus_width"))
    if not (clock and memory and width):
        return None
    source = (
        f"the device's properties: {p.multi_processor_count} multiprocessors x {LANES} lanes, {clock / 1e3:.0f} MHz"
    )
    return Peaks(p.name, 2.0 * LANES * p.multi_processor_count * clock * 1e3, 2.0 * memory * 1e3 * width / 8, source)


def name(device: str) -> str:
    """What the device is called."""
    if not device.startswith("cuda"):
        return "CPU"
    import torch

    return torch.cuda.get_device_name(device)
