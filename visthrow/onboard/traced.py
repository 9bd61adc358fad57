"""A chain of small operations on tensors, recorded once and run again in the same memory, to the
same bits. Onboard-safe.

A batch of one costs some 400 operations, and next to none of their time is arithmetic. It is memory
that is asked for, views that are made, and torch's long way to each kernel, whose code has left the
caches since the last tick. So what is the same at each call is done once: the function is called,
and each operation that reaches torch is kept with the tensors that it read and wrote. A later call
copies its arguments into the first one's and does the operations again, from the same memory into
the same memory. Views need nothing done, and what nobody reads is not worked out. NumPy, which is
quicker to call, does what has one right result; torch's own kernels do the rest.

Convention: as of a CUDA graph: shapes and types, and the way through branches, never change.
"""

import contextlib
from collections.abc import Callable, Iterator, Sequence
from functools import partial
from typing import Any

import numpy as np
import torch
from numpy.lib.stride_tricks import as_strided
from torch import Tensor
from torch.utils._python_dispatch import TorchDispatchMode

Step = tuple[Callable[..., Any], tuple[Any, ...]]
"""What is called, and with what."""

Call = tuple[Any, Sequence[Any], dict[str, Any], Any]
"""What reached torch: operation, arguments, named ones, result."""

EXACT: dict[str, np.ufunc] = {
    "abs": np.absolute,
    "neg": np.negative,
    "add": np.add,
    "sub": np.subtract,
    "mul": np.multiply,
    "div": np.divide,
    "minimum": np.minimum,
    "maximum": np.maximum,
    "lt": np.less,
    "le": np.less_equal,
    "gt": np.greater,
    "ge": np.greater_equal,
    "bitwise_not": np.invert,
    "bitwise_and": np.bitwise_and,
    "bitwise_or": np.bitwise_or,
}
"""Elementwise operations whose result IEEE 754 or logic settles, by torch's name.

A square root is none: torch's may be off by a bit.
"""

REDUCED: dict[str, np.ufunc] = {"sum": np.add, "any": np.logical_or, "all": np.logical_and}
"""Likewise over axes, of truths and whole numbers: in whatever order."""

CONSTANT = ("zeros_like", "ones_like", "full_like", "new_zeros", "new_ones", "new_full")
"""Operations whose result does not depend on the numbers that they read."""

BLOCK = 1 << 16
"""Memory in which results lie side by side, in the order in which they are worked out [bytes];
larger ones stay where they are.
"""

NAMESPACES = {"": (torch, torch._C._nn), "linalg_": (torch.linalg,)}
"""Where torch's operations stand, by how their names begin: called from there they are reached in
half the time.
"""

ALIGNED = 16  # address of a result in it [bytes]


class Traced:
    """A function of tensors that returns a tuple of them, for arrays; recorded at the first call,
    and where shapes or types are new.

    Calls must not overlap: they share their memory. What is returned is the caller's own. A call
    raises ValueError where the function changes tensors that it did not make, RuntimeError where
    its recording gives other numbers.

    Attributes:
        plain: the function itself.
    """

    def __init__(self, function: Callable[..., tuple[Tensor, ...]]) -> None:
        self.plain = function
        self._tape: _Tape | None = None

    def __call__(self, *arrays: np.ndarray) -> tuple[np.ndarray, ...]:
        tape = self._tape
        if tape is None or not tape.fits(arrays):
            tape = self._tape = _Tape(self.plain, arrays)
        return tape(arrays)

    def __getstate__(self) -> dict[str, Any]:
        """Leave the recording out: arrays of its copy would not share memory as they must."""
        return {"plain": self.plain, "_tape": None}


class _Recording(TorchDispatchMode):
    """Keeps what reaches torch, and puts what is new side by side."""

    @classmethod
    def _should_skip_dynamo(cls) -> bool:
        """Say that nobody compiles this: torch would import its compiler, 1.3 s of a core at the
        first recording, to leave it alone.
        """
        return False

    def __init__(self) -> None:
        super().__init__()
        self.calls: list[Call] = []
        self._memory, self._used = torch.zeros(BLOCK, dtype=torch.uint8).untyped_storage(), 0
        self._origin: dict[int, int] = {}

    def __torch_dispatch__(
        self, func: Any, types: Any, args: Sequence[Any] = (), kwargs: dict[str, Any] | None = None
    ) -> Any:
        out, kwargs = func(*args, **(kwargs or {})), kwargs or {}
        source = next(
            (
                t
                for t in _tensors((args, kwargs))
                if any(_address(t) == _address(o) for o in _tensors(out))
            ),
            None,
        )
        for tensor in _tensors(out):
            self._origin[id(tensor)] = id(tensor) if source is None else self.origin(source)
            if source is None:
                self._move(tensor)
        self.calls.append((func, args, kwargs, out))
        return out

    def origin(self, tensor: Tensor) -> int:
        """Return which result a tensor shows all or a part of: of views, that of what
        they look at.
        """
        return self._origin.get(id(tensor), id(tensor))

    def _move(self, tensor: Tensor) -> None:
        at = -(-self._used // ALIGNED) * ALIGNED
        until = at + tensor.untyped_storage().nbytes()
        if until <= BLOCK:
            held = tensor.clone()
            tensor.set_(self._memory, at // tensor.element_size(), tensor.shape, tensor.stride())  # type: ignore[call-overload]
            tensor.copy_(held)
            self._used = until


class _Tape:
    """One recording of a function; ``steps``: what a call does, in turn."""

    def __init__(
        self, function: Callable[..., tuple[Tensor, ...]], arrays: Sequence[np.ndarray]
    ) -> None:
        self._given = [array.copy() for array in arrays]
        given = list(map(torch.from_numpy, self._given))
        with torch.inference_mode(False), torch.no_grad(), _Recording() as recording:
            results = function(*given)
        self._calls, origin = (
            recording.calls,
            recording.origin,
        )  # the calls hold the memory that the steps work in
        varying, kept = set(map(id, given)), []
        for call in self._calls:
            func, args, kwargs, out = call
            read, wrote = (
                set(map(origin, _tensors((args, kwargs)))),
                set(map(origin, _tensors(out))),
            )
            changes = func._schema.is_mutable
            if changes and not wrote <= varying:
                raise ValueError(
                    f"{_name(func)} changes a tensor that the function did not make; expected a"
                    " function without a memory"
                )
            view = bool(read & wrote) and not changes
            if read & varying and not view and _name(func) not in CONSTANT:
                varying |= wrote
                kept.append((call, read, wrote))
        needed, steps = set(map(origin, results)), []
        for call, read, wrote in reversed(kept):
            if wrote & needed:
                needed |= read
                steps.append(_steps(*call))
        self.steps = [step for part in reversed(steps) for step in part]
        self._results, wanted = (
            [tensor.numpy() for tensor in results],
            [tensor.numpy().copy() for tensor in results],
        )
        for i, (again, own) in enumerate(zip(self(arrays), wanted)):
            if not np.array_equal(again, own, equal_nan=own.dtype.kind == "f"):
                name = getattr(function, "__qualname__", repr(function))
                raise RuntimeError(
                    f"result {i} of {name} is another one when its recording is done again;"
                    " expected the same bits"
                )

    def fits(self, arrays: Sequence[np.ndarray]) -> bool:
        """Return whether arrays have the shapes and types of the recording."""
        held = self._given
        return len(arrays) == len(held) and all(
            a.shape == b.shape and a.dtype == b.dtype for a, b in zip(arrays, held)
        )

    def __call__(self, arrays: Sequence[np.ndarray]) -> tuple[np.ndarray, ...]:
        for held, array in zip(self._given, arrays):
            held[...] = array
        with np.errstate(all="ignore"):  # torch says nothing of a division by zero
            for call, arguments in self.steps:
                call(*arguments)
        return tuple(array.copy() for array in self._results)


def _tensors(part: Any) -> Iterator[Tensor]:
    """Yield the tensors of nested arguments."""
    if isinstance(part, Tensor):
        yield part
    elif isinstance(part, list | tuple | dict):
        for inner in part.values() if isinstance(part, dict) else part:
            yield from _tensors(inner)


def _address(tensor: Tensor) -> int:
    return tensor.untyped_storage().data_ptr()


def _name(func: Any) -> str:
    return str(func._schema.name).removeprefix("aten::")


def _steps(func: Any, args: Sequence[Any], kwargs: dict[str, Any], out: Any) -> list[Step]:
    """Return what does an operation again, into the tensors that it gave."""
    if func._schema.is_mutable:
        return [(partial(func, **kwargs), tuple(args))]
    plain = kwargs.keys() <= {"dtype", "alpha"} and kwargs.get("alpha", 1) == 1
    return (_by_numpy(_name(func), list(args), out) if plain else []) or [
        _by_torch(func, args, kwargs, out)
    ]


def _by_numpy(name: str, args: list[Any], out: Any) -> list[Step]:
    """Return what does an operation by NumPy; empty where it might give other bits."""
    if name in ("cat", "stack"):
        parts, axis = [part.numpy() for part in args[0]], args[1] if len(args) > 1 else 0
        if name == "stack":
            parts = [np.expand_dims(part, axis) for part in parts]
        cuts = np.cumsum([part.shape[axis] for part in parts[:-1]])
        return [
            (np.copyto, tuple(_lines([part], to)[::-1]))
            for part, to in zip(parts, np.split(out.numpy(), cuts, axis))
            if part.size
        ]
    if name in ("_to_copy", "clone"):
        return [(partial(np.copyto, casting="unsafe"), (out.numpy(), args[0].numpy()))]
    if name == "index_select":
        return [(args[0].numpy().take, (args[2].numpy(), args[1], out.numpy(), "clip"))]
    if name in REDUCED and not args[0].is_floating_point():
        axes = tuple(np.atleast_1d(args[1])) if len(args) > 1 else None
        return [
            (
                REDUCED[name].reduce,
                (args[0].numpy(), axes, None, out.numpy(), len(args) > 2 and args[2]),
            )
        ]
    if name == "where" and len(args) == 3:
        where, one, other, to = _lines(_arrays(args, out.dtype), out.numpy())
        return [(np.copyto, (to, other)), (partial(np.copyto, where=where), (to, one))]
    if name == "clamp":
        bounds = [
            (call, bound)
            for call, bound in zip(("maximum", "minimum"), args[1:])
            if bound is not None
        ]
        sources = [args[0], *(out for _ in bounds)]
        return [
            step
            for source, (call, bound) in zip(sources, bounds)
            for step in _by_numpy(call, [source, bound], out)
        ]
    if name in ("reciprocal", "rsub"):
        name, args = (
            ("div", [1.0, args[0]]) if name == "reciprocal" else ("sub", [args[1], args[0]])
        )
    if name not in EXACT:
        return []
    kind = torch.result_type(*args) if len(args) == 2 else args[0].dtype
    if any(arg.dtype not in (kind, torch.bool) for arg in _tensors(args)) or (
        name == "div" and not kind.is_floating_point
    ):
        return []
    *arrays, to = _lines(_arrays(args, kind), out.numpy())
    # These two take no third argument by place.
    return [
        (
            (partial(EXACT[name], out=to), tuple(arrays))
            if name in ("minimum", "maximum")
            else (EXACT[name], (*arrays, to))
        )
    ]


def _arrays(args: Sequence[Any], kind: torch.dtype) -> list[np.ndarray]:
    """Return tensors and numbers as arrays; a number as torch takes it."""
    return [
        (arg if isinstance(arg, Tensor) else torch.tensor(arg, dtype=kind)).numpy() for arg in args
    ]


def _lines(arrays: list[np.ndarray], out: np.ndarray) -> list[np.ndarray]:
    """Return arguments and result of an elementwise operation with as few axes as show the same
    numbers: these are walked fastest.
    """
    arrays = [*(np.broadcast_to(array, out.shape) for array in arrays), out]
    shape: list[int] = []
    strides: list[list[int]] = []
    for axis, count in enumerate(out.shape):
        here = [array.strides[axis] for array in arrays]
        if shape and all(before == step * count for before, step in zip(strides[-1], here)):
            shape[-1], strides[-1] = shape[-1] * count, here
        elif count != 1:
            shape.append(count)
            strides.append(here)
    return [
        as_strided(array, shape, [step[i] for step in strides]) for i, array in enumerate(arrays)
    ]


def _by_torch(func: Any, args: Sequence[Any], kwargs: dict[str, Any], out: Any) -> Step:
    """Return what does an operation by torch: by its form that writes where it is told to, where it
    has one.
    """
    begins = "linalg_" if _name(func).startswith("linalg_") else ""
    for space in NAMESPACES[begins]:
        call = getattr(space, _name(func).removeprefix(begins), None)
        with contextlib.suppress(
            TypeError, RuntimeError
        ):  # it knows no out, or takes other arguments
            if call is not None:
                call(*args, **kwargs, out=out)
                return partial(call, **kwargs, out=out), tuple(args)
    wanted = [(part.name, str(part.type)) for part in func._schema.arguments]
    for overload in func.overloadpacket.overloads():
        other = getattr(func.overloadpacket, overload)
        outs = [part.name for part in other._schema.arguments if part.is_out]
        if (
            outs
            and [(part.name, str(part.type)) for part in other._schema.arguments if not part.is_out]
            == wanted
        ):
            return partial(other, **kwargs, **dict(zip(outs, _tensors(out)))), tuple(args)
    return partial(_again, func, kwargs, list(_tensors(out))), tuple(args)


def _again(func: Any, kwargs: dict[str, Any], outs: list[Tensor], *args: Any) -> None:
    for old, new in zip(outs, _tensors(func(*args, **kwargs))):
        old.copy_(new)
