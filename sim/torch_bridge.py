"""Torch views of the simulator's Warp arrays, without copies, and capture of CUDA graphs."""

import gc
from collections.abc import Callable
from typing import Any

import torch
import warp as wp

from sim.hybrid import HybridSim
from sim.kernels import state as st


class TorchViews:
    """Tensors that share memory with a simulator.

    Attributes:
        command: shape (E, 4), writable. release: shape (E,), int32, writable. goal_w: shape (E, 3).
        state, out, foreseen: name -> state or output array, of shape (E, 3), (E,), (L, E, 3), ...
    """

    def __init__(self, sim: HybridSim):
        self.command = wp.to_torch(sim.command, requires_grad=False)
        self.release = wp.to_torch(sim.release, requires_grad=False)
        self.goal_w = wp.to_torch(sim.goal_w, requires_grad=False)
        self.state = {
            name: wp.to_torch(getattr(sim.state, name), requires_grad=False)
            for name in st.STATE_FIELDS
        }
        self.out, self.foreseen = (
            {
                name: wp.to_torch(getattr(out, name), requires_grad=False)
                for name in st.OUTPUT_FIELDS
            }
            for out in (sim.out, sim.foreseen)
        )


def on_torch_stream(device: str):
    """Return a context in which Warp launches on torch's current stream, so that both can be
    captured in one CUDA graph.
    """
    if not device.startswith("cuda"):
        return wp.ScopedDevice(device)
    # during a capture it must not wait for another stream
    capturing = torch.cuda.is_current_stream_capturing()
    return wp.ScopedStream(
        wp.stream_from_torch(torch.cuda.current_stream()), sync_enter=not capturing
    )


def capture_graph(work: Callable[[], Any], **options: Any) -> "torch.cuda.CUDAGraph":
    """Capture the launches of ``work`` in a CUDA graph; ``options``: of `torch.cuda.graph`.

    Garbage collection is disabled meanwhile, because freeing a Warp array or graph would abort the
    capture.
    """
    torch.cuda.synchronize()
    graph = torch.cuda.CUDAGraph()
    gc.collect()
    collects = gc.isenabled()
    gc.disable()
    try:
        with torch.cuda.graph(graph, **options):
            work()
    finally:
        if collects:
            gc.enable()
    return graph


class ReplayedGraph:
    """Work on fixed GPU tensors. The first call executes it, the second captures it in a CUDA
    graph, which all later calls replay, on a separate stream.
    """

    def __init__(self, work: Callable[[], None]):
        self._work = work
        self._warm = False
        self._graph = None
        self._stream = torch.cuda.Stream()

    def __call__(self) -> None:
        """Execute or replay the work."""
        self._stream.wait_stream(torch.cuda.current_stream())
        if self._graph is None and self._warm:
            # autograd and NCCL's watchdog may use the device from other threads during the capture
            self._graph = capture_graph(
                self._work, stream=self._stream, capture_error_mode="thread_local"
            )
        with torch.cuda.stream(self._stream):
            if self._graph is None:
                self._work()
                self._warm = True
            else:
                self._graph.replay()
        torch.cuda.current_stream().wait_stream(self._stream)
