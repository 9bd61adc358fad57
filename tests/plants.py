"""Plants that the tests of the reference share: the paper's, and ones reduced to what a closed form
knows.
"""

from dataclasses import fields, replace
from pathlib import Path

from sim.kernels.structs import EXTENSIONS
from sim.params import AeroParams, PlantParams, ReleaseParams, RopeParams, SimParams, VehicleParams
from visthrow import config

SCENES = Path(__file__).parent / "data" / "scenes"
EVERYTHING = frozenset(EXTENSIONS)
"""One kernel for all tests of extensions: what is built in and stands at zero changes nothing."""


def paper_plant() -> PlantParams:
    """Return the paper's vehicle, rope, release and numerics."""
    schemas = {
        "vehicle": VehicleParams,
        "rope": RopeParams,
        "release": ReleaseParams,
        "sim": SimParams,
    }
    return PlantParams(
        **{
            name: config.load(schema, config.find(name, "paper"))
            for name, schema in schemas.items()
        }
    )


def calm(aero: AeroParams) -> AeroParams:
    """Return aerodynamics that do nothing, in a kernel that computes them."""
    return replace(aero, **{f.name: 0.0 for f in fields(aero) if f.name != "kind"})


def plain_vehicle(vehicle: VehicleParams, **kinds: str) -> VehicleParams:
    """Return a vehicle without aerodynamics and with an ideal battery, unless ``kinds`` says
    otherwise.
    """
    chosen = {"aero": "none", "battery": "ideal", **kinds}
    parts = {name: replace(getattr(vehicle, name), kind=kind) for name, kind in chosen.items()}
    return replace(vehicle, **parts)


def plain_plant() -> PlantParams:
    """Return the paper's plant without aerodynamics and with an ideal battery."""
    plant = paper_plant()
    return replace(plant, vehicle=plain_vehicle(plant.vehicle))
