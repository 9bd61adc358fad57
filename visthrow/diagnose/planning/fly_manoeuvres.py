"""Manoeuvres flown in the simulator as the diagnosis left it, recorded as the user records: all of them in one batch."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace

import numpy as np

from sim.effects.effect import apply
from visthrow.common import mocap
from visthrow.common.errors import DiagnoseError
from visthrow.diagnose.models.interface import Model
from visthrow.diagnose.planning.manoeuvres import PERIOD, Manoeuvre, Reference
from visthrow.diagnose.planning.plan import log_of
from visthrow.diagnose.select.result import Diagnosis
from visthrow.diagnose.throw.effects import effects_for
from visthrow.diagnose.throw.throw_model import ThrowModel
from visthrow.logs.flightlog import FlightLog
from visthrow.onboard.hover import HoverController, HoverParams

SAMPLE_PERIOD = 0.005
"""Period of the recorded poses [s]: motion capture at 200 Hz."""

COARSE = 2.0
"""Steps of a promise, in those of the search."""

AWAY = 1.5
"""Time given to a dropped payload and to the vehicle before a manoeuvre without payload begins [s]."""

HIGHEST = 75.0
"""Swing of the payload from the rotors' axis [deg] beyond which it nears the rotors, or a string hangs slack."""

TRACKING = HoverParams(max_speed=8.0, max_tilt=0.9, integral_limit=2.0)
"""A controller that follows a moving reference: the hover controller with room for it."""


def simulator_of(model: ThrowModel, diagnosis: Diagnosis, *, seed: int = 0) -> Callable[[Sequence[Manoeuvre]], list[Model | None]]:
    """Make the function that :func:`visthrow.diagnose.planning.plan.propose` simulates with.

    A manoeuvre in which this vehicle's payload swings beyond ``HIGHEST`` has no model: it is not to be flown.

    Args:
        model: of the flights at hand.
        diagnosis: for the sizes of what was found and the sensors' noise.
        seed: of the noise.
    """
    noise = _sensor_noise(diagnosis)
    asked = {e.name for e in model.effects}

    def simulate(manoeuvres: Sequence[Manoeuvre]) -> list[Model | None]:
        models: list[Model | None] = []
        for log, manoeuvre in zip(fly(model, diagnosis.theta, manoeuvres, noise, seed), manoeuvres):
            if manoeuvre.payload and not swing(log) < HIGHEST:
                models.append(None)
                continue
            there = effects_for(model.setting, set(log.channels), manoeuvre.payload, np.isfinite(manoeuvre.release))
            try:
                models.append(ThrowModel([log], model.setting.plant, sensing=model.setting.sensing, device=model.device,
                                         substep=COARSE * model.substep, only=[n for n in there if n in asked],
                                         carries=manoeuvre.payload))  # fmt: skip
            except DiagnoseError:
                models.append(None)
        return models

    return simulate


def swing(log: FlightLog) -> float:
    """Largest angle between the rope and the rotors' axis while the payload hangs [deg]; nan where it was not followed."""
    from scipy.spatial.transform import Rotation

    asked = log["release_command"]
    held = log["pos_w"].time < np.min(asked.time[asked.values > 0.5], initial=np.inf)
    hangs = log["payload_pos_w"].values[held] - log["pos_w"].values[held]
    axis = Rotation.from_quat(log["quat_wb"].values[held]).apply([0.0, 0.0, -1.0])
    cosine = np.einsum("ni,ni->n", hangs, axis) / np.linalg.norm(hangs, axis=1)
    return float(np.degrees(np.arccos(np.clip(cosine, -1.0, 1.0))).max())


def _sensor_noise(diagnosis: Diagnosis) -> dict[str, float]:
    """Deviation of each channel, as stated by the model times the scale that was found."""
    work = diagnosis.work
    out = {}
    for c, name in enumerate(work.problem.model.channels):
        sigma = [w.sigma[w.channel == c] for w in work.after.windows if np.any(w.channel == c)]
        if sigma:
            out[name] = float(np.median(np.concatenate(sigma)) * work.after.noise.scale[c])
    return out


def fly(
    model: ThrowModel, theta: Mapping[str, float], manoeuvres: Sequence[Manoeuvre], noise: dict[str, float], seed: int
) -> list[FlightLog]:
    """Fly all manoeuvres at once in the plant of the model and record poses with noise.

    Args:
        model: for the plant.
        theta: sizes of the effects in the plant that flies.
        manoeuvres: to fly; those without payload drop it first.
        noise: deviation by channel [m; rad].
        seed: of the noise.
    """
    from sim.hybrid import HybridSim

    references = [m.reference() for m in manoeuvres]
    plant = apply(model.entries, model.setting, theta).plant
    plant = replace(plant, sim=replace(plant.sim, control_period=SAMPLE_PERIOD))
    sim = HybridSim(plant, len(references), model.device)
    start = np.array([r.pos_w[0] for r in references])
    sim.place(start)
    carried = np.array([m.payload for m in manoeuvres])
    pilot = _Pilot(sim, references, carried, plant.total_mass, plant.vehicle.body.mass)
    for _ in range(round(AWAY / PERIOD)):
        pilot.step(None)
    rows = max(len(r.time) for r in references)
    sampled = [pilot.step(i) for i in range(rows)]
    return [_recorded(r, m, e, pilot, sampled, noise, np.random.default_rng([seed, e]))
            for e, (r, m) in enumerate(zip(references, manoeuvres))]  # fmt: skip


class _Pilot:
    """Follows the references and keeps what it sent."""

    def __init__(self, sim, references: Sequence[Reference], carried: np.ndarray, loaded: float, bare: float) -> None:
        self.sim, self.references, self.carried = sim, references, carried
        self.loaded, self.bare = loaded, bare
        self.controller = HoverController(TRACKING, PERIOD, len(references))
        self.sent: list[np.ndarray] = []
        self.let_go = ~carried

    def step(self, row: int | None) -> dict[str, np.ndarray]:
        """Send one command and hold it for a period; without a row, hover where the reference begins.

        Returns:
            Samples of the period: ``pos_w`` (S, E, 3), ``quat_wb``, ``payload_pos_w``.
        """
        at = [min(row or 0, len(r.time) - 1) for r in self.references]
        place, speed, push = (np.array([getattr(r, name)[i] for r, i in zip(self.references, at)])
                              for name in ("pos_w", "vel_w", "acc_w"))  # fmt: skip
        gains = self.controller.params
        goal = place + (speed + push / gains.velocity_gain) / gains.position_gain
        pos, quat, vel = (self.sim.get(name).astype(float) for name in ("pos_w", "quat_wb", "vel_w"))
        mass = np.where(self.let_go, self.bare, self.loaded)
        yaw = np.array([r.yaw[i] for r, i in zip(self.references, at)])
        command = self.controller.step(pos, quat, vel, goal, mass, yaw)
        if row is not None:
            command[:, 1:] += np.array([r.rates_b[i] for r, i in zip(self.references, at)])
            command[:, 0] *= np.array([r.thrust_factor[i] for r, i in zip(self.references, at)])
            self.let_go = self.let_go | np.array([r.release[i] for r, i in zip(self.references, at)])
            self.sent.append(command)
        self.sim.set_command(command, self.let_go)
        samples: dict[str, list[np.ndarray]] = {"pos_w": [], "quat_wb": [], "payload_pos_w": []}
        for _ in range(round(PERIOD / SAMPLE_PERIOD)):
            for name, values in samples.items():
                values.append(self.sim.get(name).astype(float))
            self.sim.step()
        return {name: np.array(values) for name, values in samples.items()}


def _recorded(reference: Reference, manoeuvre: Manoeuvre, e: int, pilot: _Pilot, sampled, noise: dict[str, float],
              rng: np.random.Generator) -> FlightLog:  # fmt: skip
    rows = len(reference.time)
    flown = {name: np.concatenate([s[name][:, e] for s in sampled[:rows]]) for name in ("pos_w", "payload_pos_w", "quat_wb")}
    flown = mocap.measured(flown, {"payload_pos_w": noise["pos_w"], **noise}, rng)
    flown["time"] = SAMPLE_PERIOD * np.arange(len(flown["pos_w"]))
    commands = np.array([row[e] for row in pilot.sent[:rows]])
    return log_of(reference, flown, commands, payload=manoeuvre.payload)
