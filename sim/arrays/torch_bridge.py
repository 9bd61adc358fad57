"""The one bridge between the simulator's Warp arrays and torch tensors: views of the same memory, no copies."""

import torch
import warp as wp

from sim.arrays import state as st
from sim.hybrid import HybridSim


class TorchViews:
    """Tensors that share memory with a simulator.

    Attributes:
        command: shape (E, 4), writable. release: shape (E,), int32, writable. goal_w: shape (E, 3).
        state, out, foreseen: dictionaries of the state and output arrays: (E, 3), (E,), (L, E, 3), ...
    """

    def __init__(self, sim: HybridSim):
        self.command = wp.to_torch(sim.command, requires_grad=False)
        self.release = wp.to_torch(sim.release, requires_grad=False)
        self.goal_w = wp.to_torch(sim.goal_w, requires_grad=False)
        self.state = {name: wp.to_torch(getattr(sim.state, name), requires_grad=False) for name in st.STATE_FIELDS}
        self.out, self.foreseen = (
            {name: wp.to_torch(getattr(out, name), requires_grad=False) for name in st.OUTPUT_FIELDS}
            for out in (sim.out, sim.foreseen)
        )


def on_torch_stream(device: str):
    """Context in which Warp launches on torch's current stream, so that both can be captured in one CUDA graph."""
    if not device.startswith("cuda"):
        return wp.ScopedDevice(device)
    capturing = torch.cuda.is_current_stream_capturing()  # a capture may not wait for another stream
    return wp.ScopedStream(wp.stream_from_torch(torch.cuda.current_stream()), sync_enter=not capturing)
