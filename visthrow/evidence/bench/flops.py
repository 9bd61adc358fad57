"""Operations and bytes of one env-step, from the simulator's own source; see :mod:`visthrow.evidence.bench.counting`."""

import ast
import builtins
import importlib
import importlib.util
from types import SimpleNamespace
from typing import Any
from unittest import mock

import numpy as np
import warp as wp

from sim.arrays import state as st
from sim.hybrid import HybridSim
from sim.params import GRAVITY, PlantParams
from visthrow.evidence.bench import counting

STEP_WRITES = ("payload_pos_w", "payload_vel_w", "separated")
"""Outputs that every control step writes; the others follow a separation."""


class _ByValue(ast.NodeTransformer):
    """``x = y`` copies a vector or struct in Warp; make Python do so."""

    def visit_Assign(self, node: ast.Assign) -> ast.Assign:
        if isinstance(node.value, ast.Name | ast.Attribute):
            node.value = ast.Call(ast.Name("_by_value", ast.Load()), [node.value], [])
        return node


class _Source:
    """Modules of ``sim`` executed with the counting numbers in Warp's place; the real ones stay as they are."""

    def __init__(self):
        self._modules: dict[str, SimpleNamespace] = {}
        self._builtins = {**vars(builtins), "__import__": self._import}

    def load(self, name: str) -> SimpleNamespace:
        if name not in self._modules:
            spec = importlib.util.find_spec(name)
            with open(spec.origin, encoding="utf-8") as file:
                tree = ast.fix_missing_locations(_ByValue().visit(ast.parse(file.read())))
            scope = {"__name__": name, "__builtins__": self._builtins, "_by_value": counting.copy}
            exec(compile(tree, spec.origin, "exec"), scope)
            self._modules[name] = SimpleNamespace(**scope)
        return self._modules[name]

    def _import(self, name, scope=None, local=None, wanted=(), level=0):
        if name == "warp":
            return counting.warp
        if name.split(".")[0] != "sim" or name == "sim.params":
            return builtins.__import__(name, scope, local, wanted, level)
        if importlib.util.find_spec(name).submodule_search_locations is None:
            return self.load(name)
        return SimpleNamespace(**{part: self._submodule(f"{name}.{part}") for part in wanted})

    def _submodule(self, name: str) -> Any:
        return importlib.import_module(name) if name == "sim.params" else self.load(name)


def _filled(kind: type, row: Any) -> Any:
    """Counted value of a type from what numpy holds."""
    if issubclass(kind, counting.Struct):
        out = kind()
        for name, inner in kind.__annotations__.items():
            setattr(out, name, _filled(inner, row[name]))
        return out
    return kind(*row) if issubclass(kind, counting.Vec) else kind(row)


class _Translation:
    """From what a kernel is launched with to counted values."""

    def __init__(self, sim: HybridSim, t: Any):
        self._sim = sim
        self._kinds = {id(real): getattr(t, name) for name, real in vars(sim.types).items()} | {id(wp.int32): int}

    def array(self, a: wp.array) -> counting.Array:
        """Array of one environment."""
        value, kind = a.numpy(), self._kinds[id(a.dtype)]
        return counting.Array([_filled(kind, row) for row in (value[:, 0] if a.ndim == 2 else value)], a.ndim == 2)

    def argument(self, given: Any) -> Any:
        """One argument of the step kernel: a number, an array, or the struct of state or output arrays."""
        if isinstance(given, wp.array):
            return self.array(given)
        if isinstance(given, int | float):
            return counting.Real(given)
        names = st.STATE_FIELDS if given is self._sim.state else st.OUTPUT_FIELDS
        return SimpleNamespace(**{name: self.array(getattr(given, name)) for name in names})


def run_counted(sim: HybridSim) -> tuple[SimpleNamespace, int]:
    """Run one control step of a simulator of one environment in counting numbers; the simulator is left as it is.

    Args:
        sim: whose state, command and release request to start from.

    Returns:
        The state after the step and the operations that it took.
    """
    source = _Source()
    t = source.load("sim.arrays.structs").types(sim.params.sim.precision)
    kernels = source.load("sim.step").build_step(t, sim.params, extensions=sim.extensions)
    with mock.patch.object(wp, "launch") as launch:  # what the simulator would launch with, whatever it is
        sim.step()
    translation = _Translation(sim, t)
    given = launch.call_args.args[2]
    counted = [translation.argument(g) for g in given]
    before = counting.TALLY["operations"]
    kernels.step(*counted)
    return next(c for c, g in zip(counted, given) if g is sim.state), counting.TALLY["operations"] - before


def hovering(plant: PlantParams, device: str = "cpu") -> HybridSim:
    """One environment at hover, its rope a little aslant."""
    sim = HybridSim(plant, 1, device)
    tilt = np.array([np.sin(0.2), 0.0, -np.cos(0.2)])
    sim.place(pos_w=np.array([[0.0, 0.0, 1.3]]), cable_dir_w=np.tile(tilt, (1, plant.rope.segments, 1)))
    weight = GRAVITY * plant.total_mass
    sim.set_command(np.array([[weight, 0.1, -0.1, 0.05]]))
    return sim


def env_step(plant: PlantParams, device: str = "cpu") -> dict[str, int]:
    """Operations of one control step at hover: in all, and of one substep on average."""
    _, count = run_counted(hovering(plant, device))
    return {"total": count, "a_substep": round(count * plant.sim.substep / plant.sim.control_period)}


def traffic(plant: PlantParams, device: str = "cpu") -> dict[str, int]:
    """Bytes of one environment.

    Returns:
        ``state``: of its state; ``environment``: of all that the simulator holds for it; ``traffic``: moved by a
        control step at least: state read and written, command and release request read, payload written.
    """
    sim = HybridSim(plant, 1, device)
    state = sum(getattr(sim.state, name).capacity for name in st.STATE_FIELDS)
    out = {name: getattr(sim.out, name).capacity for name in st.OUTPUT_FIELDS}
    given = sim.command.capacity + sim.release.capacity
    held = state + sum(out.values()) + given + sim.goal_w.capacity + sim.episode.capacity
    return {"state": state, "environment": held, "traffic": 2 * state + given + sum(out[name] for name in STEP_WRITES)}
