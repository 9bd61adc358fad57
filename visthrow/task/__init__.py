"""Schema of the throwing task and of an experiment: plant, observation, reward and training.

SI units.

An experiment file of ``configs/train`` names the files of vehicle, rope, camera and task and holds
the learning parameters. :func:`plant_of` returns the part that the simulator needs."""

import math
import statistics
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Annotated, Any, Literal

from camera.params import CameraParams
from sim.params import (
    GRAVITY,
    AirParams,
    LawParams,
    PlantParams,
    RandomizationParams,
    ReleaseParams,
    RopeParams,
    SensingParams,
    SimParams,
    VehicleParams,
)
from sim.scaling.vehicle_class import FleetParams
from visthrow import config
from visthrow.common.errors import ConfigError, suggest
from visthrow.config.bounds import Bound, Bounded, NotNegative, NotNegativeVector, Positive, Vector

Count = Annotated[int, Bound(1)]
Counts = tuple[Count, ...]
Share = Annotated[float, Bound(0.0, 1.0, "(]")]

MAX_RATE = (10.0, 10.0, 4.0)
"""Body rates that a 3-inch quadrotor follows well [rad/s]; not in the paper."""
AIR_DENSITY = 1.2  # at 20 degrees [kg/m^3]
SOUND = 343.0  # speed of sound in this air [m/s]


@dataclass(frozen=True)
class ActionParams(Bounded):
    """Limits of the command; see :mod:`visthrow.onboard.actions`."""

    # body rates at +-1 [rad/s] and collective thrust at +1 [N]; an experiment replaces 0 by the
    # vehicle's value
    max_rate: NotNegativeVector = (0.0, 0.0, 0.0)
    max_thrust: NotNegative = 0.0


@dataclass(frozen=True)
class ObservationParams(Bounded):
    """The actor's observations; see :mod:`visthrow.onboard.observations`."""

    layout: Literal["state", "vision"]
    history: int  # number of earlier payload measurements besides the current one
    validity: bool  # vision: whether the actor observes which keypoints are valid
    # age of all measurements, drawn per episode from this range [s]
    latency: tuple[float, float]
    # largest deviation from this age to either side, uniform, drawn per step [s]
    latency_jitter: NotNegative = 0.0
    # whether the actor observes a fit of the goal's velocity; see visthrow.onboard.goal_motion
    goal_velocity: bool = False
    # whether the actor observes the mean goal of all steps, and in vision the positions of the
    # payload's keypoints; see visthrow.onboard.goal_motion
    located: bool = False
    # number of earlier steps whose velocity, body rates and action the actor observes: they show
    # the vehicle's response
    response: int = 0
    # properties of a fleet's vehicle that the actor observes; see visthrow.task.fleet
    setup: Literal["none", "given", "exact"] = "none"

    @property
    def oldest(self) -> float:
        """Return the age of the oldest possible measurement [s]."""
        return self.latency[1] + self.latency_jitter

    def __post_init__(self) -> None:
        super().__post_init__()
        low, high = self.latency
        if not 0.0 <= low <= high < 1.0:
            raise ConfigError(
                f"task.observation.latency is {low} to {high} s; expected an ascending range from 0"
                " to less than 1 s"
            )
        if self.latency_jitter > low:
            raise ConfigError(
                f"task.observation.latency_jitter is {self.latency_jitter} s; expected at most the"
                f" shortest latency, {low} s"
            )


@dataclass(frozen=True)
class NoiseParams(Bounded):
    """Gaussian noise of measurements and commands; the camera's parameters hold the keypoints'
    noise. Source: the paper, Sec. III-C.
    """

    observation_step: NotNegative  # per step, in each entry's SI unit
    observation_bias: NotNegative  # per episode
    command_step: NotNegative  # per step, in normalised commands
    command_bias: NotNegative  # per episode


@dataclass(frozen=True)
class BoundsParams(Bounded):
    """Bounds that end an episode (the paper, Sec. III-C); the numbers are ours."""

    altitude: tuple[float, float]  # of the vehicle [m]
    horizontal: Positive  # distance of the vehicle from the spawn axis [m]
    tilt_deg: Positive  # between body z and the vertical [deg]
    time_limit: Positive  # a failure, never bootstrapped [s]

    def __post_init__(self) -> None:
        super().__post_init__()
        if not self.altitude[0] < self.altitude[1]:
            raise ValueError(
                f"task.bounds.altitude is {self.altitude} m; expected the lower limit before the"
                " upper one"
            )


@dataclass(frozen=True)
class RewardParams(Bounded):
    """Coefficients of Table II, named by their meanings; see :mod:`visthrow.task.rewards`."""

    scale: float  # factor of the whole reward, for the learning algorithm; the paper's is 1
    velocity: float  # alpha_v
    angular_velocity: float  # alpha_omega
    relative_velocity: float  # alpha_p
    smoothness: float  # beta
    rate_command: Vector  # c^omega
    command_change: tuple[float, float, float, float]  # c^Delta
    l1_mix: float  # eta
    carry_time: float  # gamma_t [1/s]
    landing: float  # k_l
    landing_decay: float  # lambda [1/m]
    time_of_flight: float  # k_h
    proximity: float  # k_p
    termination: float  # k_d


@dataclass(frozen=True)
class TargetParams(Bounded):
    """Motion of the target: a constant horizontal velocity with a uniform heading. Landing errors
    refer to the target's position at impact.
    """

    # uniform in this range, drawn per episode [m/s]
    speed: tuple[NotNegative, NotNegative] = (0.0, 0.0)

    def __post_init__(self) -> None:
        super().__post_init__()
        if not 0.0 <= self.speed[0] <= self.speed[1]:
            raise ValueError(
                f"target.speed is {self.speed} m/s; expected an ascending range from 0 or more"
            )

    @property
    def moves(self) -> bool:
        """Return whether targets move."""
        return self.speed[1] > 0.0


@dataclass(frozen=True)
class TaskParams:
    """The throwing task."""

    action: ActionParams
    observation: ObservationParams
    noise: NoiseParams
    start: RandomizationParams
    bounds: BoundsParams
    reward: RewardParams
    target: TargetParams = TargetParams()


PRIVILEGED = (
    "exact",
    "payload_velocity",
    "release_timer",
    "time",
    "mass",
    "voltage",
    "goal_velocity",
    "cargo",
    "mount",
    "pose_age",
    "vehicle",
)
"""Quantities that a critic may observe besides the actor's observation; see
:class:`visthrow.training.env.ThrowEnv`.
"""


@dataclass(frozen=True)
class PPOParams(Bounded):
    """Learning parameters of rsl_rl's PPO."""

    environments: Count
    steps: Count  # per environment and iteration
    iterations: Count
    hidden: Counts
    activation: str
    normalize: bool  # empirical observation normalisation
    initial_std: Positive
    epochs: Count
    minibatches: Count
    learning_rate: Positive
    schedule: Literal["adaptive", "fixed"]
    desired_kl: Positive  # at the first iteration
    final_kl: Positive  # after the share settled; linear in between
    discount: Share
    gae_lambda: Share
    clip: Positive
    entropy: NotNegative
    value_coefficient: NotNegative
    max_grad_norm: Positive
    # number format of products in the hidden layers; weights are always float32
    products: Literal["float32", "bfloat16"] = "float32"
    settled: Share = 1.0  # share of the training after which desired_kl has become final_kl
    # largest number of rope segments in training, with the solver chain; 0 for the plant's number
    segments: Annotated[int, Bound(0)] = 0
    # shortest simulation step in training, with the solver chain; 0 for the plant's [s]
    substep: NotNegative = 0.0
    # whether PPO optimises weight matrices by Muon, as first_order and distillation always do; see
    # visthrow.training.ppo.network.MuonAdam
    muon: bool = False
    critic: Counts = ()  # hidden layers of the critic; empty for the actor's
    # number of first iterations in which only the critic learns
    critic_first: Annotated[int, Bound(0)] = 0
    # inputs of only the critic, from PRIVILEGED; those that a task does not have are omitted
    privileged: tuple[str, ...] = PRIVILEGED[:8]

    def __post_init__(self) -> None:
        super().__post_init__()
        if not self.hidden:
            raise ConfigError("hidden is empty; expected one layer or more")
        for name in self.privileged:
            if name not in PRIVILEGED or self.privileged.count(name) > 1:
                raise ConfigError(
                    f"ppo.privileged has {name!r}; {suggest(name, PRIVILEGED)}, each once"
                )


@dataclass(frozen=True)
class FirstOrderParams(Bounded):
    """Learning parameters of :mod:`visthrow.training.first_order`; ``ppo`` determines the number of
    throws for a gradient, and the network.
    """

    iterations: Count = 1000  # gradient steps
    horizon: int = 48  # length of a flight [control steps]; the latch trips near the 35th
    segments: Count = 5  # see ppo.segments
    substep: Positive = 0.004  # see ppo.substep [s]
    decay: Positive = 0.985  # factor on derivatives, per step backward
    learning_rate: Positive = 2e-3  # at the first iteration
    adapting: Count = 160  # gradient steps of a training that starts from a policy
    adapting_rate: Positive = 2e-4  # learning rate at the first of them; a tenth at the last
    adapting_width: float = 0.15  # width of the hazard in them
    final_rate: Positive = 5e-5  # learning rate at the last iteration; half a cosine in between
    max_grad_norm: Positive = 1.0
    width: Positive = 0.5  # of the hazard at the first iteration, in units of the fifth action
    final_width: Positive = 0.35  # at most the first
    # share of the training after which the width is the final one; geometric before
    sharp: Positive = 0.3
    # shares of the training between which the hazard's value becomes the latch's
    latched: tuple[float, float] = (0.1, 0.2)
    # first step with a release at the start of training; without it the payload would be dropped
    # at once
    first_release: int = 24
    # shares of the training between which this step falls to 0
    free: tuple[float, float] = (0.05, 0.15)
    initial_release: float = -2.0  # fifth action of the untrained network
    saturation: float = 1.0  # cost of the squared excess of an action over its limits

    def __post_init__(self) -> None:
        super().__post_init__()
        if (
            not all(0.0 <= low < high for low, high in (self.free, self.latched))
            or self.final_width > self.width
        ):
            actual = (
                f"free is {self.free}, latched {self.latched}, the hazard {self.width} to"
                f" {self.final_width} wide"
            )
            raise ConfigError(
                f"{actual}; expected ascending ranges from 0 or more, and a width that falls"
            )


@dataclass(frozen=True)
class DistillationParams(Bounded):
    """Learning parameters of :mod:`visthrow.training.distillation`; ``ppo.environments`` is the
    number of throws in an iteration.
    """

    teacher: str = "state"  # state policy: a shipped name or a file
    iterations: Count = 500
    horizon: Count = 72  # longest throw [control steps]
    hidden: Count = 256  # width of the encoder's first layer
    inner: Counts = ()  # widths of its further layers
    memory: Count = 128  # size of the recurrent unit's state
    epochs: Count = 1
    minibatches: Count = 4
    learning_rate: Positive = 2e-3  # at the first iteration
    final_rate: NotNegative = 5e-5  # at the last one; half a cosine in between
    action_weight: NotNegative = 0.3  # weight of the action's error in the loss


@dataclass(frozen=True)
class DiagnosedParams(Bounded):
    """The uncertainty of the plant after a diagnosis, written by ``visthrow diagnose apply``.

    Training draws ``plants`` plants from the joint posterior: the deviations of the effects are
    normal with this covariance about the configuration, so that their correlations are kept.
    Environment e flies plant ``e % plants``. With 1 all environments fly the configuration.
    """

    effects: tuple[str, ...] = ()  # names in the catalogue
    covariance: tuple[tuple[float, ...], ...] = ()  # of the deviations, in the effects' units
    plants: Count = 1

    def __post_init__(self) -> None:
        super().__post_init__()
        rows = [len(row) for row in self.covariance]
        if rows != [len(self.effects)] * len(self.effects):
            message = f"diagnosed.covariance has rows of {rows} for {len(self.effects)} effects"
            raise ConfigError(f"{message}; expected one row and one column for each")


@dataclass(frozen=True)
class Experiment:
    """The complete configuration of a training run, which is written with its results."""

    vehicle: VehicleParams
    rope: RopeParams
    release: ReleaseParams
    sim: SimParams
    camera: CameraParams
    task: TaskParams
    ppo: PPOParams
    air: AirParams = field(default_factory=AirParams)
    laws: tuple[LawParams, ...] = ()  # laws from a diagnosis, in addition to those of the blocks
    # sensing by motion capture; only the diagnosis reads it
    sensing: SensingParams = field(default_factory=SensingParams)
    diagnosed: DiagnosedParams = field(default_factory=DiagnosedParams)
    algorithm: Literal["ppo", "first_order", "distillation"] = "ppo"
    first_order: FirstOrderParams = field(default_factory=FirstOrderParams)
    distillation: DistillationParams = field(default_factory=DistillationParams)
    # if set, policies are trained for many vehicles, and task and sim are in the fleet's units
    fleet: FleetParams | None = None
    flown: tuple[
        str, ...
    ] = ()  # key=value changes of this configuration that its policies are flown and measured with

    @property
    def iterations(self) -> int:
        """Return the number of iterations in a whole training."""
        return self._chosen.iterations

    @property
    def samples(self) -> int:
        """Return the number of environment steps in an iteration."""
        chosen = self._chosen
        return self.ppo.environments * (
            chosen.steps if isinstance(chosen, PPOParams) else chosen.horizon
        )

    @property
    def _chosen(self) -> PPOParams | FirstOrderParams | DistillationParams:
        chosen: PPOParams | FirstOrderParams | DistillationParams = getattr(self, self.algorithm)
        return chosen

    def __post_init__(self) -> None:
        action = self.task.action
        if action.max_thrust == 0.0:
            action = replace(action, max_thrust=4.0 * self.vehicle.controller.max_thrust)
        roll, pitch, yaw = action.max_rate
        followed = _largest_rates(self.vehicle)
        rates = (roll or followed[0], pitch or followed[1], yaw or followed[2])
        action = replace(action, max_rate=rates)
        object.__setattr__(self, "task", replace(self.task, action=action))
        if self.fleet is None and abs(self.camera.payload_radius - self.rope.payload_radius) > 1e-9:
            message = (
                f"camera.payload_radius is {self.camera.payload_radius} m and rope.payload_radius"
                f" {self.rope.payload_radius} m"
            )
            raise ConfigError(f"{message}; expected the same ball")
        if self.fleet is None:
            for wrong in (*_find_wrong_units(self), *_find_impossible_vehicle(self)):
                raise ConfigError(wrong)


def _largest_rates(vehicle: VehicleParams) -> Vector:
    """Return the largest body rates to command to a vehicle [rad/s].

    They are at most :data:`MAX_RATE`. A rate error as large as the largest rate demands at most
    half of the motors' range: beyond that the mixer saturates, and the collective thrust no longer
    follows its command.
    """
    controller = vehicle.controller
    rotors = vehicle.rotors
    room = 0.5 * (controller.max_thrust - controller.min_thrust)
    roll_arm, pitch_arm = (
        statistics.fmean(arm * arm for arm in arms) / max(map(abs, arms))
        for arms in (rotors.y, rotors.x)
    )
    arms = (roll_arm, pitch_arm, vehicle.thrust.torque_ratio)
    roll, pitch, yaw = (
        min(most, 4.0 * room * arm / gain) if gain else most
        for most, arm, gain in zip(MAX_RATE, arms, controller.p_gain)
    )
    return roll, pitch, yaw


def _find_wrong_units(e: Experiment) -> Iterator[str]:
    """Yield contradictions among an experiment's lengths and times, which a number in a wrong unit
    causes.
    """
    start = e.task.start
    bounds = e.task.bounds
    release = e.release
    low, high = bounds.altitude
    hangs = e.rope.length + e.rope.payload_offset - e.rope.mount[2]
    if not low <= start.spawn_height <= high:
        yield (
            f"task.start.spawn_height is {start.spawn_height:g} m; expected within"
            f" task.bounds.altitude, {low:g} to {high:g} m"
        )
    if not start.spawn_height - hangs > release.landing_height:
        yield (
            f"the payload hangs {hangs:g} m (rope.length, rope.payload_offset) below a vehicle that"
            f" starts at {start.spawn_height:g} m (task.start.spawn_height); expected it above the"
            " ground"
        )
    lag = e.vehicle.motor.time_constant
    if lag >= bounds.time_limit:
        yield (
            f"vehicle.motor.time_constant is {lag:g} s; expected less than task.bounds.time_limit,"
            f" {bounds.time_limit:g} s"
        )


def _find_impossible_vehicle(e: Experiment) -> Iterator[str]:
    """Yield reasons why an experiment's vehicle is impossible: weight above the thrust, size, speed
    of the rotors.
    """
    vehicle = e.vehicle
    rotors = e.vehicle.rotors
    motor = e.vehicle.controller.max_thrust
    mass = plant_of(e).total_mass
    thrust = e.task.action.max_thrust
    if not GRAVITY * mass < min(4.0 * motor, thrust):
        yield (
            f"vehicle, rope and payload weigh {mass:g} kg, {GRAVITY * mass:.3g} N, but thrust is"
            f" {4.0 * motor:g} N at most (four times vehicle.controller.max_thrust) and asked up to"
            f" {thrust:g} N (task.action.max_thrust): it cannot hover; expected more thrust"
        )
    reach = max(map(math.hypot, rotors.x, rotors.y)) + rotors.radius
    if reach > e.task.bounds.horizontal:
        yield (
            f"vehicle.rotors reach {reach:g} m from the middle, and it may fly"
            f" {e.task.bounds.horizontal:g} m far (task.bounds.horizontal); expected less"
        )
    tip = math.sqrt(motor / vehicle.thrust.k_f) * rotors.radius
    wake = math.sqrt(motor / (2.0 * AIR_DENSITY * math.pi * rotors.radius**2))
    if not wake < tip < SOUND:
        yield (
            f"vehicle.thrust.k_f {vehicle.thrust.k_f:g} N s^2/rad^2 and vehicle.rotors.radius"
            f" {rotors.radius:g} m make blade tips of {tip:.3g} m/s for {motor:g} N"
            " (vehicle.controller.max_thrust); expected more than the air through the rotor,"
            f" {wake:.3g} m/s, and less than sound, {SOUND:g} m/s"
        )


def load_experiment(name: str | Path, changes: Iterable[str] = ()) -> Experiment:
    """Load a configuration of ``configs/train`` or a TOML file, with changes ``key=value``.

    Raises ConfigError: no such file exists, or a change is invalid.
    """
    return config.load(Experiment, config.find("train", name), changes)


def plant_of(experiment: Experiment) -> PlantParams:
    """Return the plant of an experiment."""
    return PlantParams(
        experiment.vehicle,
        experiment.rope,
        experiment.release,
        experiment.sim,
        experiment.air,
        experiment.laws,
    )


def contract_of(experiment: Experiment, *, whole: bool = False) -> dict[str, Any]:
    """Return the conditions that a flight must share with a policy's training; see
    :mod:`visthrow.onboard.policy`.

    The contract of a vision policy includes the camera. No contract includes noise and
    randomisation, which only concern training. A field with a default is included if its value
    differs from the default, so that a policy from before the field existed fits the default.
    ``whole``: include every entry that a contract can have, for any observation and plant."""
    from visthrow.onboard.observations import layout_of
    from visthrow.onboard.pilot import camera_conditions

    task = experiment.task
    layout = layout_of(task.observation)
    contract = {
        "observation": {
            **config.to_dict(task.observation, defaults=whole),
            "dimension": layout.dimension,
        },
        "action": {**config.to_dict(task.action, defaults=whole), "dimension": 5},
        "control_period": experiment.sim.control_period,
        "release": {"lag": experiment.release.lag, "threshold": experiment.release.threshold},
        "vehicle": config.to_dict(experiment.vehicle, defaults=whole),
        "rope": config.to_dict(experiment.rope, defaults=whole),
    }
    acting = config.to_dict(experiment, defaults=whole)
    contract |= {key: acting[key] for key in ("air", "laws") if key in acting}
    if whole or task.observation.layout == "vision":
        contract["camera"] = camera_conditions(experiment.camera)
    # a fleet's policy is for any vehicle: the conditions of a single one do not apply
    if experiment.fleet is not None and not whole:
        contract["fleet"] = {
            "rope_length": experiment.fleet.rope_length,
            "total_mass": experiment.fleet.total_mass,
        }
        contract["action"] = {"max_rate": list(task.action.max_rate), "dimension": 5}
        contract = {
            key: value
            for key, value in contract.items()
            if key not in ("vehicle", "rope", "release")
        }
    return contract


def draw_plants(experiment: Experiment, seed: int) -> list[PlantParams]:
    """Return ``diagnosed.plants`` plants drawn about the experiment's plant; only the latter if the
    number is 1 or no effect is uncertain.

    A draw outside an effect's physical bounds is moved to the bound. Raises ConfigError: the
    covariance is not symmetric or has a negative eigenvalue."""
    diagnosed = experiment.diagnosed
    plant = plant_of(experiment)
    if diagnosed.plants == 1 or not diagnosed.effects:
        return [plant]
    import numpy as np

    from sim.effects.effect import apply, possible_together
    from sim.effects.setting import Setting, generalise, specialise
    from visthrow.config.effects import choose_effects

    covariance = np.array(diagnosed.covariance)
    values, vectors = np.linalg.eigh(covariance)
    if not np.allclose(covariance, covariance.T) or values.min() < -1e-9 * values.max():
        raise ConfigError(
            "diagnosed.covariance is not a covariance matrix: it is not symmetric, or has a"
            " negative eigenvalue"
        )
    normal = np.random.default_rng(seed).standard_normal((diagnosed.plants, len(diagnosed.effects)))
    base = generalise(Setting(plant, experiment.sensing))
    effects = {
        name: effect.bound_by(base) for name, effect in choose_effects(diagnosed.effects).items()
    }
    plants = []
    for draw in normal * np.sqrt(np.maximum(values, 0.0)) @ vectors.T:
        theta = {
            name: float(np.clip(x, *effects[name].bounds))
            for name, x in zip(diagnosed.effects, draw)
        }
        theta = possible_together(effects, base, theta)
        plants.append(specialise(apply(effects, base, theta).plant, plant))
    return plants
