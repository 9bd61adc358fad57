"""Joint fit of effects for a first configuration of a vehicle or motor, from standalone flights or
tests, with covariance.

A diagnosis decides which effects are present; a fit assumes that all chosen ones are, with their
slabs as the only prior."""

import hashlib
from collections import defaultdict
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy import ndarray

from sim.params import VehicleParams, change_values
from visthrow import config
from visthrow.common.errors import DiagnoseError, expect_known
from visthrow.diagnose.inputs.setup import Setup
from visthrow.diagnose.models.model_interface import Model, Sizes, Window
from visthrow.logs.flightlog import FlightLog

DEFAULT_FREE = {
    "flyer": (
        "thrust_gain",
        "thrust_curve",
        "rotor_drag_xy",
        "rotor_drag_z",
        "cmd_delay",
        "frame_tilt_x",
        "frame_tilt_y",
    ),
    "imu": ("thrust_gain", "thrust_curve", "motor_tau", "cmd_delay", "inertia_xy", "inertia_z"),
    "stand": ("thrust_gain", "thrust_linear", "load_cell_zero", "power_gain", "idle_power"),
}
"""Model -> effects to fit by default; those that the logs do not determine keep their prior."""
ROUNDS = 4  # largest number of linearisations
# posterior over prior standard deviation above which the logs do not determine an effect
UNKNOWN_SHARE = 0.5


@dataclass(frozen=True)
class FitResult:
    """Fitted sizes of effects with their covariance."""

    names: tuple[str, ...]
    units: tuple[str, ...]
    theta: ndarray  # in the effects' units, shape (K,)
    covariance: ndarray  # shape (K, K)
    identified: tuple[bool, ...]  # whether the logs determine an effect, rather than its prior
    rms_before: Mapping[str, float]  # channel -> root mean square residual, in its unit
    rms_after: Mapping[str, float]
    middle_speed: float = 0.0  # of a stand's steps, the reference of its linear term [rad/s]

    @property
    def sentences(self) -> list[str]:
        """Return the size of each effect with its 95 % interval."""
        sentences = []
        reach = 1.96 * np.sqrt(np.diag(self.covariance))
        for i, (name, size) in enumerate(zip(self.names, self.theta)):
            interval = f"95 % [{size - reach[i]:.6g}, {size + reach[i]:.6g}]"
            note = "" if self.identified[i] else " (the prior: these logs do not determine it)"
            sentences.append(f"{name} = {size:.6g} {self.units[i]}, {interval}{note}")
        return sentences


def fit(model: Model, free: Sequence[str]) -> FitResult:
    """Fit effects of a model jointly.

    Latent forces and noise levels of the model's windows are estimated too.
    Raises DiagnoseError: the model does not have an effect, or ``free`` is empty.
    """
    from visthrow.diagnose.select.point import Problem, fit, linearise

    names = [effect.name for effect in model.effects]
    expect_known(free, names, "no effect '{}' to fit", DiagnoseError)
    if not free:
        raise DiagnoseError(f"nothing to fit; name effects with --free: {', '.join(names)}")
    columns = [names.index(name) for name in free]
    before = model.windows({})
    problem = Problem.of(model, before, range(len(before)))
    point = linearise(problem, np.zeros(len(names)), windows=before)
    for _ in range(ROUNDS):
        start = point.theta
        point = fit(point, columns)
        point = linearise(problem, point.theta, point.noise)
        if np.max(np.abs(point.theta - start)) < 0.5:  # floors
            break
    slab = problem.priors.slab[columns]
    posterior = np.linalg.inv(point.information[np.ix_(columns, columns)] + np.diag(slab**-2.0))
    floors = problem.priors.floor[columns]
    identified = np.sqrt(np.diag(posterior)) < UNKNOWN_SHARE * slab
    return FitResult(
        tuple(free),
        units=tuple(model.effects[i].unit for i in columns),
        theta=point.theta[columns] * floors,
        covariance=posterior * np.outer(floors, floors) + np.diag(floors**2),
        identified=tuple(identified.tolist()),
        rms_before=_rms(model, before),
        rms_after=_rms(model, point.windows),
        middle_speed=model.middle_speed,
    )


def _rms(model: Model, windows: Sequence[Window]) -> dict[str, float]:
    """Return the root mean square residual of each channel in the windows, in its unit."""
    channel = np.concatenate([w.channel for w in windows])
    squares = np.concatenate([w.residual for w in windows]) ** 2
    return {
        name: np.sqrt(np.mean(squares[channel == i]))
        for i, name in enumerate(model.channels)
        if np.any(channel == i)
    }


def vehicle_of(setup: Setup, result: FitResult, base: VehicleParams) -> VehicleParams:
    """Return the parameters of a simulated vehicle with the fitted values; others as in ``base``.

    A map from commands to thrust does not determine rotor speeds: the thrust coefficient is then
    that of ``base``, and the largest thrust is the map's. Raises DiagnoseError: the setup's model
    is of no vehicle."""
    size = defaultdict(float, zip(result.names, map(float, result.theta)))
    if setup.flyer is not None:
        return _vehicle_of_flyer(setup.flyer, size, base)
    if (stand := setup.stand) is not None:
        values = {
            "thrust.k_f": stand.k_f * (1.0 + size["thrust_gain"]),
            "thrust.k_1": stand.k_f * size["thrust_linear"] * result.middle_speed,
            "thrust.voltage_coefficient": size["thrust_voltage"],
            "battery.reference_voltage": stand.reference_voltage,
        }
        return change_values(base, values)
    raise DiagnoseError(
        f"'{setup.about}' is neither a vehicle nor a motor; use a setup with [flyer] or [stand]"
    )


def _vehicle_of_flyer(p: Any, size: Sizes, base: VehicleParams) -> VehicleParams:
    gain = 1.0 + size["thrust_gain"]
    mass = p.mass + size["mass_quad"]
    drag_xy = p.drag_xy + size["rotor_drag_xy"]
    values = {
        "body.mass": mass,
        "motor.kind": "first_order",
        "motor.time_constant": max(p.motor_time_constant + size["motor_tau"], 1e-3),
        "aero.kind": "rotor_drag",
        "aero.drag_x": drag_xy,
        "aero.drag_y": drag_xy,
        "aero.drag_z": p.drag_z + size["rotor_drag_z"],
        "aero.parasitic": max(size["parasitic"], 0.0),
        "aero.translational_lift": size["translational_lift"],
        "battery.reference_voltage": p.reference_voltage,
        "thrust.voltage_coefficient": p.voltage_coefficient + size["battery_sag"],
        "queue.delay": max(p.command_delay + size["cmd_delay"], 0.0),
    }
    if p.input == "motor_speed":
        # the curve's change of thrust refers to hover, where it is measured
        values["thrust.k_f"] = p.thrust_map[2] * gain
        values["thrust.k_1"] = p.thrust_map[1] * gain
    elif p.input == "motor_command":
        full = sum(p.thrust_map) * gain
        hover = mass * p.gravity / 4.0
        values["controller.max_thrust"] = full * (1.0 + size["thrust_curve"] * (full / hover - 1.0))
    else:
        values["thrust.gain"] = tuple(gain * scale for scale in base.thrust.gain)
    return change_values(base, values)


def write(
    folder: str | Path,
    name: str,
    setup: Setup,
    result: FitResult,
    logs: Sequence[FlightLog],
    base: VehicleParams,
) -> list[Path]:
    """Write ``fit.json`` with covariance and provenance, and ``vehicle.toml`` if the model is of a
    vehicle or motor.

    Returns their paths. Raises StorageError: the folder cannot be written.
    """
    from visthrow.common.storage import atomic_write, write_json

    folder = Path(folder)
    sources = {str(log.meta.get("source", "")): _digest(log) for log in logs}
    write_json(folder / "fit.json", {"setup": name, "logs": sources, **asdict(result)})
    if setup.flyer is None and setup.stand is None:
        return [folder / "fit.json"]
    vehicle = vehicle_of(setup, result, base)
    atomic_write(folder / "vehicle.toml", _head(name, result, sources) + config.dumps(vehicle))
    return [folder / "vehicle.toml", folder / "fit.json"]


def _head(name: str, result: FitResult, sources: Mapping[str, str]) -> str:
    lines = [
        f"# Fitted by `visthrow diagnose fit` with the setup '{name}'; covariance and provenance"
        " also in fit.json."
    ]
    listed = [*result.sentences, *list_covariance(result.names, result.covariance)]
    lines += [f"# {line}" for line in listed]
    lines += [f"# log {Path(source).name}: {digest}" for source, digest in sources.items()]
    return "\n".join(lines) + "\n\n"


def list_covariance(names: Sequence[str], covariance: Iterable[Sequence[float]]) -> list[str]:
    """Return the lines of a comment that state a covariance."""
    rows = [f"  {'  '.join(f'{x: .3e}' for x in row)}" for row in covariance]
    return [f"covariance of {', '.join(names)}:", *rows] if names else []


def _digest(log: FlightLog) -> str:
    """Return a fingerprint of a log's samples."""
    digest = hashlib.sha256()
    for name in sorted(log.channels):
        channel = log[name]
        digest.update(name.encode())
        digest.update(channel.time.tobytes())
        digest.update(np.ascontiguousarray(channel.values).tobytes())
    return digest.hexdigest()[:16]
