"""A chain of small tensor operations without Python between them: the same operations, so the same bits. Onboard-safe.

A batch of one costs some 100 operations of a few microseconds each, and Python as much again. The first call records the
operations that a function makes (``torch.jit.trace``) and takes what is constant (``torch.jit.freeze``) and slices of all that
there is out of the record; later calls run it. Nothing is fused or reordered on the CPU.
"""

import sys
import warnings
from collections.abc import Callable
from typing import Any


class Traced:
    """A function of tensors whose shapes, and whose way through its branches, never change.

    Attributes:
        plain: the function itself; what is called for good where this torch cannot record.
    """

    def __init__(self, function: Callable[..., Any]) -> None:
        """Record at the first call."""
        self.plain = function
        self._call: Callable[..., Any] | None = None

    def __call__(self, *tensors: Any) -> Any:
        """Call the function."""
        if self._call is None:
            self._call = self._recorded(tensors)
        return self._call(*tensors)

    def _recorded(self, tensors: tuple[Any, ...]) -> Callable[..., Any]:
        import torch

        class Recorded(torch.nn.Module):
            def forward(module, *given: Any) -> Any:
                return self.plain(*given)

        with warnings.catch_warnings():
            # The shape of the input is asked for in checks of it, and the whole facility is called old.
            warnings.simplefilter("ignore")
            try:
                recorded = torch.jit.freeze(torch.jit.trace(Recorded().eval(), tensors, check_trace=False))
                _without_whole_slices(recorded.graph)
            except (AttributeError, RuntimeError, NotImplementedError):
                return self.plain
        try:  # torch's own executor of records of small operations, where this build has it: 280 us a tick instead of 320
            return torch._C._jit_to_static_module(recorded._c)
        except (AttributeError, RuntimeError):
            return recorded.forward


def _without_whole_slices(graph: Any) -> None:
    """Take out slices that are all of what they slice, such as the first of ``x[:, 0]``: each costs as much as a sum."""
    for node in list(graph.nodes()):
        if node.kind() != "aten::slice":
            continue
        source, _, *span = node.inputs()
        start, end, step = (value.toIValue() for value in span)
        if start in (0, None) and end == sys.maxsize and step == 1:
            node.output().replaceAllUsesWith(source)
            node.destroy()
