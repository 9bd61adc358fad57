"""Functions of tensors as functions of arrays, compiled by torch. Onboard-safe."""

import warnings
from collections.abc import Callable
from typing import Any

import numpy as np
import torch
from numpy import ndarray
from torch import Tensor

Shapes = tuple[tuple[tuple[int, ...], np.dtype[Any]], ...]


class Compiled:
    """A function of arrays that runs a function of tensors without its Python code.

    Branches and constants are those of the first call; other shapes or types compile it again.
    A function that draws random numbers or keeps a memory cannot be compiled.

    Attributes:
        plain: the function of tensors, which returns a tuple of them.
    """

    def __init__(self, function: Callable[..., tuple[Tensor, ...]]) -> None:
        self.plain = function
        self._programs: dict[Shapes, Callable[..., tuple[Tensor, ...]]] = {}

    def __call__(self, *arrays: ndarray) -> tuple[ndarray, ...]:
        """Run the function; results share no memory with the arguments."""
        shapes = tuple((array.shape, array.dtype) for array in arrays)
        program = self._programs.get(shapes)
        if program is None:
            program = self._programs[shapes] = self._compile(arrays)
        return tuple(tensor.numpy().copy() for tensor in program(*map(torch.from_numpy, arrays)))

    def _compile(self, arrays: tuple[ndarray, ...]) -> Callable[..., tuple[Tensor, ...]]:
        examples = tuple(torch.from_numpy(array.copy()) for array in arrays)
        with warnings.catch_warnings(), torch.inference_mode(False), torch.no_grad():
            warnings.simplefilter("ignore")  # of branches that depend on shapes alone
            return torch.jit.trace(self.plain, examples, check_trace=False)

    def __getstate__(self) -> dict[str, Any]:
        """Leave compiled programs out of copies: they belong to this process."""
        return {"plain": self.plain, "_programs": {}}
