"""Experiments with a fleet: one policy for any vehicle of a class.

The task of such an experiment is stated for a rope of ``fleet.rope_length`` and a total mass of
``fleet.total_mass``. Every vehicle is flown in units in which its rope length and mass have these
values (:mod:`sim.scaling.units`). In these units the task is the same for all vehicles, including
targets, bounds and rewards; the control period in seconds grows with the square root of the rope
length. The remaining differences are the real differences between vehicles.

A vision policy's camera is stated in these units too: on a vehicle with a rope twice as long the
lens is twice as far from the vehicle's centre, and the square on the ground is twice as wide. The
ball's radius is the vehicle's own.

With the set-up ``given`` the actor observes the throttle in hover, the share of rope and payload in
the total mass, the lag of the release, and the unit of time [s], which determines the latencies of
links and sensors. ``exact`` adds :data:`HIDDEN`, which is unknown on board: it serves as an upper
bound and as the critic's input."""

import math
from dataclasses import dataclass

import torch

from sim.params import GRAVITY, PlantParams, change_values
from sim.scaling.units import PLANT, Units, convert_units, dimensions_of
from sim.scaling.vehicle_class import draw
from visthrow import config
from visthrow.common.errors import PolicyError
from visthrow.common.toml_text import tables_beside
from visthrow.onboard import actions as act
from visthrow.onboard import observations as ob
from visthrow.onboard.policy import Policy
from visthrow.task import Experiment, contract_of, plant_of

TASK = PLANT | dimensions_of(tables_beside(__file__, "dimensions.toml"))
"""Dimensions of the fields of plant and task."""

HIDDEN = (
    "motor.time_constant",
    "queue.delay",
    "body.inertia.0",
    "body.inertia.2",
    "rotors.x.0",
    "rotors.radius",
    "rotors.inertia",
    "thrust.torque_ratio",
    "controller.p_gain.0",
    "controller.i_gain.0",
    "controller.d_gain.0",
    "controller.feedforward_gain.0",
    "controller.setpoint_time_constant",
    "controller.gyro_time_constant",
    "controller.voltage_compensation",
    "battery.resistance",
    "aero.drag_x",
    "rope_mass",
    "payload_offset",
    "mount.2",
)
"""Parameters of vehicle and rope that the actor does not observe."""


@dataclass(frozen=True)
class Member:
    """A vehicle of a fleet with its rope and release."""

    plant: PlantParams  # stated in these units
    units: Units

    @property
    def max_thrust(self) -> float:
        """Return the collective thrust of an action of +1, in these units."""
        return 4.0 * self.plant.vehicle.controller.max_thrust

    @property
    def first_action(self) -> list[float]:
        """Return the action that holds the vehicle in hover."""
        return act.hover_action(GRAVITY * self.plant.total_mass, self.max_thrust)

    @property
    def given_setup(self) -> list[float]:
        """Return the properties that are known on board: throttle in hover, share of rope and
        payload in the mass, lag of the release, unit of time [s].
        """
        plant = self.plant
        return [
            self.first_action[0],
            plant.rope.hanging_mass / plant.total_mass,
            plant.release.lag,
            self.units.time,
        ]

    @property
    def exact(self) -> list[float]:
        """Return the known properties and the logarithms of the hidden ones."""
        return [*self.given_setup, *(math.log(abs(self._number(path))) for path in HIDDEN)]

    def _number(self, path: str) -> float:
        if hasattr(self.plant.vehicle, path.split(".")[0]):
            value = self.plant.vehicle
        else:
            value = self.plant.rope
        for part in path.split("."):
            # type: ignore[index]
            value = value[int(part)] if part.isdigit() else getattr(value, part)
        return float(value)  # type: ignore[arg-type]

    def setup(self, kind: str) -> list[float]:
        """Return the properties of a kind in :data:`visthrow.onboard.observations.SETUPS`."""
        return {"none": [], "given": self.given_setup, "exact": self.exact}[kind]


def members(experiment: Experiment) -> list[Member]:
    """Return the vehicles of the experiment's fleet; none without a fleet.

    The landing height and the clearance margin belong to the task, so they are in its units
    already."""
    fleet = experiment.fleet
    if fleet is None:
        return []
    nominal = plant_of(experiment)
    plants = [draw(fleet, nominal, fleet.first + k) for k in range(fleet.count)]
    release = experiment.release
    task = {
        "release.landing_height": release.landing_height,
        "release.clearance_margin": release.clearance_margin,
        "sim": experiment.sim,
    }
    vehicles = []
    for plant in plants or [nominal]:
        units = fleet.units_of(plant)
        vehicles.append(Member(change_values(convert_units(plant, units), task), units))
    return vehicles


def single_vehicle(experiment: Experiment, number: int = 0) -> Experiment:
    """Return the experiment of one vehicle of the fleet, with vehicle and task in SI units and
    without a fleet.
    """
    chosen = members(experiment)[number]
    inverse_units = chosen.units.inverse
    plant = convert_units(chosen.plant, inverse_units)
    camera = experiment.camera
    size = chosen.units.length
    sensors = experiment.task.observation  # their delays do not follow size
    values = {name: getattr(plant, name) for name in ("vehicle", "rope", "release", "sim", "air")}
    values |= {
        "task": convert_units(experiment.task, inverse_units, TASK),
        "camera.mount.position_b": tuple(size * x for x in camera.mount.position_b),
        "camera.payload_radius": plant.rope.payload_radius,
        "camera.goal_side": size * camera.goal_side,
        "fleet": None,
        "flown": (),
        "task.action.max_thrust": 4.0 * plant.vehicle.controller.max_thrust,
        "task.observation.setup": "none",
        "task.observation.latency": sensors.latency,
        "task.observation.latency_jitter": sensors.latency_jitter,
    }
    return change_values(experiment, values)


def specialise(
    policy: Policy, experiment: Experiment, number: int = 0
) -> tuple[Policy, Experiment]:
    """Convert a fleet's policy to a policy for one vehicle in SI units; return it and its
    experiment.

    The units are absorbed by the normaliser, and the vehicle's properties by the first layer's
    bias, so on board it is like any other policy. Raises PolicyError: the policy was not trained
    for a fleet, or it observes properties that only a simulator knows."""
    observation = policy.contract.get("observation", {})
    if (
        "fleet" not in policy.contract
        or observation.get("setup") == "exact"
        or policy.mean is None
        or policy.std is None
    ):
        raise PolicyError(
            "the policy's contract is for one vehicle; expected a policy that was trained for a"
            ' fleet with setup = "given"'
        )
    one = single_vehicle(experiment, number)
    chosen = members(experiment)[number]
    layout = ob.layout_of(experiment.task.observation)
    sizes = _sizes(layout, chosen.units)
    fixed = layout.dimension - layout.setup
    spread = policy.std + policy.eps
    stated = torch.tensor(chosen.setup(experiment.task.observation.setup))
    first = policy.weights[0]
    bias = policy.biases[0] + first[:, fixed:] @ ((stated - policy.mean[fixed:]) / spread[fixed:])
    contract = contract_of(one)
    made_by = {**policy.made_by, "config": config.to_dict(one, defaults=False)}
    return (
        Policy(
            (first[:, :fixed], *policy.weights[1:]),
            (bias, *policy.biases[1:]),
            policy.activation,
            contract,
            made_by,
            policy.mean[:fixed] * sizes,
            spread[:fixed] * sizes,
        ),
        one,
    )


def _sizes(layout: ob.Layout, units: Units) -> torch.Tensor:
    """Return the SI unit of each entry of an observation without the set-up, shape (D,)."""
    length = units.length
    speed = units.length / units.time
    rate = 1.0 / units.time
    vehicle = [length] * 3 + [speed] * 3 + [rate] * 3 + [1.0] * 6
    thing = 1.0 if layout.name == "vision" else length  # images have no size
    offsets = [thing] * (layout.goal + layout.payload * (1 + layout.history))
    places = ([length] * 2 + [1.0] * 4)[: layout.located]
    motion = [speed] * layout.motion
    step = [speed] * 3 + [rate] * 3 + [1.0] * 4
    return torch.tensor(
        vehicle
        + [1.0] * 5
        + offsets
        + [1.0] * (1 + layout.validity)
        + places
        + motion
        + step * layout.response
    )
