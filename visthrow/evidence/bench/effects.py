"""What each effect that a plant may have costs in a control step, and that effects which are off cost nothing."""

import argparse
import dataclasses

from sim.arrays.structs import EXTENSIONS, extensions_of
from sim.params import LawParams, PlantParams
from visthrow.evidence.bench import flops
from visthrow.evidence.bench.records import Report, Table, finish

SMALL: dict[str, tuple[str, dict]] = {
    "gain": ("vehicle.thrust", {"gain": (1.01, 1.0, 1.0, 1.0)}),
    "wind": ("air", {"wind_w": (0.1, 0.0, 0.0)}),
    "ground_effect": ("air", {"ground_effect": 1.0}),
    "payload_drag": ("rope", {"payload_drag": 1e-3}),
    "mount_damping": ("rope", {"mount_damping": 1e-5}),
    "swing_damping": ("rope", {"swing_damping": 1e-3}),
    "downwash": ("rope", {"downwash": 0.01}),
    "payload_spin": ("rope", {"payload_side": 1e-4}),
    "compliance": ("rope", {"compliance": 1e-3}),
    "lag_tension": ("release", {"lag_tension": 0.01}),
    "kick": ("release", {"kick_along": 0.1}),
    "rope_tail": ("release", {"rope_tail": 0.5}),
}
"""Extension of the kernel -> part of the plant and the numbers that ask for it."""
LAW = LawParams("payload force", ("speed",), "vertical_cross_vel", 0.02)


def with_effect(plant: PlantParams, name: str, scale: float = 1.0) -> PlantParams:
    """The plant with a little of an effect; with ``scale`` 0 the effect is written down but off."""
    if name == "push":
        return dataclasses.replace(plant, laws=(LAW,) if scale else ())
    part, values = SMALL[name]
    off = {"gain": (1.0, 1.0, 1.0, 1.0)}
    if not scale:
        values = {key: off.get(key, tuple(0.0 for _ in v) if isinstance(v, tuple) else 0.0) for key, v in values.items()}
    owner, _, inner = part.partition(".")
    old = getattr(plant, owner)
    new = dataclasses.replace(old, **{inner: dataclasses.replace(getattr(old, inner), **values)} if inner else values)
    return dataclasses.replace(plant, **{owner: new})


def counts(plant: PlantParams) -> dict[str, dict[str, int]]:
    """Floating-point operations of a control step: ``plain``, and of each extension ``on`` and ``off``."""
    plain = flops.env_step(plant)["total"]
    found = {"plain": {"on": plain, "off": plain}}
    for name in EXTENSIONS:
        on, off = (with_effect(plant, name, scale) for scale in (1.0, 0.0))
        needed = extensions_of([on.vehicle], [on.rope], [on.air], [on.release], on.laws)
        if name not in needed:
            raise ValueError(f"{SMALL[name]} asks for {sorted(needed)}: expected {name}")
        found[name] = {"on": flops.env_step(on)["total"], "off": flops.env_step(off)["total"]}
    return found


def run(args: argparse.Namespace) -> int:
    """Count, print, keep."""
    from visthrow import config
    from visthrow.task import Experiment, plant_of

    found = counts(plant_of(config.load(Experiment, config.find("train", args.config), args.overrides)))
    plain = found.pop("plain")["on"]
    rows = tuple(
        (EXTENSIONS[name], f"{n['off'] - plain:+d}", f"{n['on'] - plain:+d}", f"{100 * (n['on'] / plain - 1):+.1f} %")
        for name, n in found.items()
    )
    table = Table(f"Operations of a control step beside the {plain} without any", ("effect", "off", "on", "on, in all"), rows)
    note = "Counted by running the kernel's source in counting numbers, one environment at hover; a law counts with its forces."
    worst = max(n["off"] for n in found.values())
    said = "Every effect that is off costs nothing." if worst == plain else "An effect that is off costs something."
    return finish(Report("effects", "What effects cost in the fused step", (table,), (note, said), {"plain": plain, **found}), args)
