"""Schema of the cooperative task: an experiment whose vehicle and rope apply to every member.

The rope's ``payload_mass`` is each member's share of the load."""

import dataclasses
from dataclasses import dataclass, field
from typing import Annotated, Any

from sim.hybrid import rope_variants
from sim.params import change_values
from visthrow import config
from visthrow.common.errors import ConfigError
from visthrow.config.bounds import Bound, Bounded, NotNegative, Positive
from visthrow.onboard import observations as ob
from visthrow.task import Experiment, Share, contract_of
from visthrow.task.measurement import pilots_hover

Range = tuple[NotNegative, NotNegative]

MESSAGE = 9
"""Width of an actor's observation of another vehicle: relative position 3, rotation 6."""


@dataclass(frozen=True)
class TeamParams(Bounded):
    """A team, its initial states, its messages and its faults."""

    vehicles: Annotated[int, Bound(2)] = 2  # V
    tilt_deg: Range = (25.0, 45.0)  # angle of the cables from the vertical at the start [deg]
    # largest angle between the formation and the normal to the throw at the start [deg]
    across_deg: NotNegative = 20.0
    goal: Range = (0.3, 2.3)  # distance of the goal from the start's centre [m]
    # age of a member's data on the others; half of the throws have the lower one [s]
    age: Range = (0.02, 0.06)
    rotor_reach: Positive = 0.135  # distance from a vehicle's centre to its outermost blade tip [m]
    margin: Positive = 0.1  # gap below which a step has a cost [m]
    margin_cost: NotNegative = 50.0  # for each step and each metre below the margin
    contact_cost: NotNegative = 50.0  # of a contact, in addition to that of every failure
    # first control step in which latches may trip at the start of a training, without which the
    # load would be dropped at once; shares of the training between which the step falls to 0
    first_release: Annotated[int, Bound(0)] = 15
    free: tuple[Share, Share] = (0.1, 0.3)
    # faults of vehicle 0: factor of its thrust, additional delay of its latch
    weak: Range = (1.0, 1.0)  # [-]
    late: Range = (0.0, 0.0)  # [s]
    faulty: Annotated[float, Bound(0.0, 1.0)] = 0.0  # share of the worlds with each fault
    central: bool = False  # whether one policy observes and commands all members

    @property
    def flown(self) -> int:
        """Return the number of vehicles that one call of the policy commands."""
        return self.vehicles if self.central else 1


@dataclass(frozen=True)
class TeamExperiment(Experiment):
    """The complete configuration of a team's training."""

    team: TeamParams = field(default_factory=TeamParams)


LEVELS = 20
"""Number of worlds after which the faults repeat."""


def layout_of(experiment: TeamExperiment) -> ob.Layout:
    """Return the layout of a member's observation: that of a single vehicle, then the other
    vehicles, their age, and the control steps since the latches tripped.

    Raises ConfigError: the layout requires a goal that is fitted over a throw.
    """
    layout = ob.layout_of(experiment.task.observation)
    if layout.fits:
        raise ConfigError(
            "task.observation.located, or a moving target, in a team; expected neither: members do"
            " not fit the goal over a throw"
        )
    messages = MESSAGE * (experiment.team.vehicles - 1) + 2
    return dataclasses.replace(layout, setup=messages)


def members(experiment: TeamExperiment) -> dict[str, list[Any]]:
    """Return vehicles, releases and ropes of the rows, for
    :class:`visthrow.cooperative.team_sim.TeamSim`.

    In a share ``faulty`` of :data:`LEVELS` worlds vehicle 0 is weak, and in the same number its
    latch is late, with values evenly spaced over their ranges. These worlds repeat.
    """
    team = experiment.team
    vehicle = experiment.vehicle
    release = experiment.release
    vehicles = []
    releases = []
    faults = round(team.faulty * LEVELS)
    for world in range(LEVELS):
        weak = world < faults
        late = world >= LEVELS - faults
        part = (world if weak else LEVELS - 1 - world) / max(faults - 1, 1)
        gain = interpolate(team.weak, part) if weak else 1.0
        delay = interpolate(team.late, part) if late else 0.0
        weakened = {"thrust.gain": tuple(gain * one for one in vehicle.thrust.gain)}
        delayed = dataclasses.replace(release, lag=release.lag + delay)
        vehicles += [change_values(vehicle, weakened), *[vehicle] * (team.vehicles - 1)]
        releases += [delayed, *[release] * (team.vehicles - 1)]
    ropes = rope_variants(experiment.rope, experiment.task.start)
    return {"vehicles": vehicles, "releases": releases, "ropes": ropes}


def interpolate(interval: tuple[float, float], part: Any) -> Any:
    """Return the value at a share of the way from the lower to the upper end."""
    low, high = interval
    return low + (high - low) * part


FAULTS: dict[str, dict[str, Any]] = {
    "none": {},
    "weak": {"weak": (0.9, 0.9)},
    "late": {"late": (0.03, 0.03)},
    "old": {"age": (0.06, 0.06)},
}
"""Fault -> changes of the team, for measured throws with a single fault."""


def as_flown(experiment: TeamExperiment, fault: str) -> TeamExperiment:
    """Return the experiment with starts from hover, with the formation normal to the throw, and
    with one of :data:`FAULTS` in every world.
    """
    start = experiment.task.start
    hover = {"tilt_deg": (33.0, 37.0), "across_deg": 5.0, "faulty": 1.0}
    hover |= {"weak": (1.0, 1.0), "late": (0.0, 0.0), "age": (experiment.team.age[0],) * 2}
    values = {f"team.{name}": value for name, value in (hover | FAULTS[fault]).items()}
    variants = {name: getattr(start, name) for name in ("tether_variants", "tether_spread")}
    return change_values(
        experiment, values | {"task.start": change_values(pilots_hover(), variants)}
    )


def team_contract(experiment: TeamExperiment) -> dict[str, Any]:
    """Return the conditions that a throw must share with the training of its policy."""
    contract = contract_of(experiment)
    contract["observation"]["dimension"] = experiment.team.flown * layout_of(experiment).dimension
    contract["action"]["dimension"] *= experiment.team.flown
    return contract | {"team": config.to_dict(experiment.team)}
