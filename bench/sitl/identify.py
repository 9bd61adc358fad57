"""Errors of our controller block against Betaflight's: rate doublets through the firmware, the
block fitted to them, the residual.

    python bench/sitl/alone.py python bench/sitl/identify.py --out out/identify --seconds 36

Writes ``flight.npz``, ``vehicle.toml`` and ``fit.json``: relative rms of the rates on doublets that
were not fitted, by the shipped block and by the fitted one. ``python -m bench.direct --plant
bench.sitl.identify:make_fitted`` throws with the fitted vehicle. ``doublets.npz`` is the flight as
motion capture and runner see it: `diagnose explain` takes it with the firmware's blackbox. Commands
wait as in a throw."""

import argparse
import dataclasses
import json
import os
from pathlib import Path

import numpy as np
from scipy.optimize import least_squares
from scipy.signal import lfilter

from bench.sitl.direct import FlightClock, set_up
from hil.links.backends.base import Held
from hil.params import HilParams
from hil.poses.pose import PAYLOAD
from hil.rehearsal.fake_mocap import SLACK, FakeMocapParams, Mocap
from sim.effects.firmware import calibrated_voltage, controller_of
from sim.hybrid import HybridSim
from sim.params import GRAVITY, VehicleParams
from tests.sitl import test_betaflight as bench
from visthrow import config
from visthrow.logs.flightlog import FlightRecorder
from visthrow.logs.readers.blackbox.decoder import read_blackbox
from visthrow.onboard.hover import HoverController, HoverParams
from visthrow.task import plant_of
from visthrow.throws.loading import load_policy
from visthrow.throws.wire_plant import HybridWirePlant

PERIOD = 0.002
BEFORE = 0.02
LENGTH = 0.36
"""A window begins so long before its doublet and lasts so long [s]."""

EVERY = 0.9
"""Between two doublets [s]: the hover recovers in between."""

SIZES = ((1.0, 2.5, 5.0, 8.0), (1.0, 2.5, 5.0, 8.0), (0.5, 1.0, 2.0, 3.0))
"""Of doublets about x, y, z [rad/s]."""

LIFTS = (0.6, 1.0, 1.5, 2.2)
"""Thrust during a doublet, times that of the hover."""

IDLE = 0.055
"""motor_idle, 5.5 %."""

STALL = 3
"""Periods without a motor output that count as a stall of the firmware."""

NAMES = ("delay", "voltage", "gyro", "p", "i", "d", "p_yaw", "i_yaw")
REST = ("integral_x", "integral_y", "integral_z")
"""The firmware's integrals at the start of the recording, over their gains [rad]."""


def fly(folder: Path, seconds: float, seed: int = 0) -> dict[str, np.ndarray]:
    """Hover through the firmware with a doublet of a rate now and then; states and commands of each
    period.
    """
    params = config.load(HilParams, config.find("hil", "betaflight_sitl"))
    settings = set_up(bench.program(), folder, params).parent
    run = folder / "run"
    run.mkdir(parents=True, exist_ok=True)
    desk = bench.Bench(run, settings)
    backend = Held(desk.backend, params.delay.hold)
    recorder = FlightRecorder({"source": "doublets"})
    mocap = Mocap(FakeMocapParams(), seed)
    rng = np.random.default_rng(seed)
    plant = desk.plant
    hover = HoverController(HoverParams(max_thrust=plant.max_thrust), bench.TICK)
    rows = []
    starts = []
    try:
        desk.take()
        clock = FlightClock(desk.fake)
        while mocap.due(plant.time):  # earlier measurements are not recorded
            mocap.measure(plant.time, plant.state)
        end = plant.time + seconds
        due = plant.time + 2.0
        doublet = None
        lift = 1.0
        while plant.time < end:
            state = plant.state
            views = [state[name].astype(float)[None] for name in ("pos_w", "quat_wb", "vel_w")]
            command = hover.step(*views, plant.home_w, plant.mass[0])[0]
            if plant.time >= due:
                axis = int(rng.integers(3))
                size = rng.choice(SIZES[axis]) * rng.choice((-1.0, 1.0))
                doublet = (
                    axis,
                    size,
                    plant.time,
                    rng.integers(2, 5) * bench.TICK,
                )
                due += EVERY
                lift = rng.choice(LIFTS)
                starts.append((plant.time, axis, size, lift))
            command[0] *= (
                lift
                if doublet is not None and plant.time - doublet[2] < 2 * doublet[3] - 1e-6
                else 1.0
            )
            if doublet is not None and plant.time - doublet[2] < 2 * doublet[3] - 1e-6:
                command[1:] = 0.0
                command[1 + doublet[0]] = (
                    doublet[1] if plant.time - doublet[2] < doublet[3] - 1e-6 else -doublet[1]
                )
            backend.send(command, plant.time)
            recorder.add(plant.time, command=command)
            backend.service(plant.time)
            for _ in range(round(bench.TICK / PERIOD)):
                now = plant.look()
                pos = plant.state["pos_w"]
                answered = desk.fake.answered
                inside = (now["voltage"], now["charge_used"], *now["motor_speed"])
                moving = (plant.time, *now["rate_b"], *now["quat_wb"], *now["vel_w"], *pos)
                rows.append((*moving, *command, answered, *inside, *np.ravel(plant.rope())))
                end_of_period = plant.time + PERIOD
                if (waits := backend.due()) is not None and waits < end_of_period - SLACK:
                    clock.sleep_until(waits)
                    backend.service(waits)
                clock.sleep_until(end_of_period)
                for pose in mocap.measure(plant.time, plant.state) if mocap.due(plant.time) else ():
                    ours = (
                        {"payload_pos_w": pose.pos}
                        if pose.body == PAYLOAD
                        else {"pos_w": pose.pos, "quat_wb": pose.quat}
                    )
                    recorder.add(plant.time, **ours)
    finally:
        desk.close()
    recorder.log().save(folder / "doublets.npz")
    return {"rows": np.array(rows), "starts": np.array(starts)}


def change_vehicle(vehicle: VehicleParams, theta: np.ndarray) -> VehicleParams:
    """A vehicle with the settings' controller, changed by `NAMES`: delay [s], voltage [V], 1 +
    logarithms of factors of the others.
    """
    delay, voltage = theta[:2].tolist()
    gyro, p, i, d, p_yaw, i_yaw = np.exp(theta[2:] - 1.0).tolist()
    c = vehicle.controller
    scale = lambda gain, both, yaw: (gain[0] * both, gain[1] * both, gain[2] * yaw)  # noqa: E731
    full = c.max_thrust * (voltage / c.calibration_voltage) ** 2
    controller = dataclasses.replace(
        c,
        gyro_time_constant=gyro * c.gyro_time_constant,
        p_gain=scale(c.p_gain, p, p_yaw),
        i_gain=scale(c.i_gain, i, i_yaw),
        d_gain=scale(c.d_gain, d, 1.0),
        max_thrust=full,
        min_thrust=full * IDLE**2,
        calibration_voltage=voltage,
    )
    return dataclasses.replace(
        vehicle, controller=controller, queue=dataclasses.replace(vehicle.queue, delay=delay)
    )


class Windows:
    """Doublets as the firmware flew them, and as the simulator does."""

    def __init__(self, flight: dict[str, np.ndarray], policy: str):
        rows = flight["rows"]
        first = np.searchsorted(rows[:, 0], flight["starts"][:, 0] - BEFORE)
        count = round(LENGTH / PERIOD)
        first = first[first + count < len(rows)]
        # Where the firmware was not scheduled for a while its outputs stand still: such a doublet
        # says nothing of its controller.
        stood = np.array(
            [
                np.diff(rows[at - round(BEFORE / PERIOD) : at + count, 18][::STALL]).min() == 0
                for at in first
            ]
        )
        self.starts = flight["starts"][: len(first)][~stood]
        self.stalled = int(stood.sum())
        first = first[~stood]
        self.flight = rows
        self.first = first
        self.rows = np.stack([rows[at : at + count] for at in first])  # (E, T, fields)
        lead = round(0.1 / PERIOD)
        # commands before a window, for the queue
        self.earlier = np.stack([rows[at - lead : at, 14:18] for at in first])
        plant = plant_of(load_policy(policy).experiment)
        self.plant = dataclasses.replace(
            plant, sim=dataclasses.replace(plant.sim, control_period=PERIOD)
        )

    def controller(self, vehicle: VehicleParams, rest: np.ndarray) -> dict[str, np.ndarray]:
        """Integral, smoothed set-point and gyro of the block at each period of the whole flight,
        from commands and measured rates.
        """
        c = vehicle.controller
        rows = self.flight
        late = np.searchsorted(rows[:, 0], rows[:, 0] - vehicle.queue.delay + 1e-6) - 1
        rate_command = rows[np.maximum(late, 0), 15:18]
        rate = rows[:, 1:4]

        def smooth(values: np.ndarray, time_constant: float) -> np.ndarray:
            share = 1.0 - np.exp(-PERIOD / time_constant)
            return lfilter(
                [share], [1.0, share - 1.0], values, axis=0, zi=(1.0 - share) * values[:1]
            )[0]

        setpoint = smooth(rate_command, c.setpoint_time_constant)
        gyro = smooth(rate, c.gyro_time_constant)
        if c.kind != "motor_mixing":
            return {"setpoint": setpoint, "gyro": gyro, "integral": np.zeros_like(rate)}
        error = rate_command - rate - np.array(c.gyro_share) * (gyro - rate)
        error[:, :2] *= np.maximum(
            1.0 - np.abs(rate_command - setpoint)[:, :2] / c.relax_threshold, 0.0
        )
        return {
            "setpoint": setpoint,
            "gyro": gyro,
            "integral": c.i_gain * (rest + PERIOD * np.cumsum(error, axis=0)),
        }

    def rates(self, vehicle: VehicleParams, chosen: np.ndarray, rest: np.ndarray) -> np.ndarray:
        """Rates by the simulator under the same commands [rad/s], shape (E, T, 3); rest: see
        `REST`.
        """
        rows = self.rows[chosen]
        sim = HybridSim(dataclasses.replace(self.plant, vehicle=vehicle), len(rows))
        start = rows[:, 0]
        cable_dir, cable_vel = np.moveaxis(start[:, 25:].reshape(len(start), 2, -1, 3), 1, 0)
        sim.place(
            start[:, 11:14], start[:, 4:8], start[:, 8:11], start[:, 1:4], cable_dir, cable_vel
        )
        sim.state.voltage.assign(start[:, 19].astype(np.float32))
        sim.state.charge_used.assign(start[:, 20].astype(np.float32))
        sim.state.motor_speed.assign(start[:, 21:25].astype(np.float32))
        for name, value in self.controller(vehicle, rest).items():
            getattr(sim.state, name).assign(value[self.first[chosen] - 1].astype(np.float32))
        depth = sim.state.queue.shape[0]
        newest_first = self.earlier[chosen][:, ::-1][
            :, np.minimum(np.arange(depth), self.earlier.shape[1] - 1)
        ]
        sim.state.queue.assign(np.swapaxes(newest_first, 0, 1).astype(np.float32))
        out = np.empty((*rows.shape[:2], 3))
        for k in range(rows.shape[1]):
            out[:, k] = sim.get("rate_b")
            sim.set_command(rows[:, k, 14:18])
            sim.step()
        return out

    def miss(self, vehicle: VehicleParams, chosen: np.ndarray, rest: np.ndarray) -> float:
        """Rms of the difference over the rms of the firmware's rates."""
        flown = self.rows[chosen][:, :, 1:4]
        return float(
            np.sqrt(((self.rates(vehicle, chosen, rest) - flown) ** 2).mean() / (flown**2).mean())
        )


def fit(
    windows: Windows, vehicle: VehicleParams, chosen: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Numbers of :func:`change_vehicle`, and `REST`, that fit the chosen windows best."""
    start = np.array([0.001, vehicle.controller.calibration_voltage, *np.ones(6), *np.zeros(3)])
    low = np.array([0.0, 14.0, *np.full(6, -3.0), *np.full(3, -5.0)])
    high = np.array([0.06, 18.0, *np.full(9, 5.0)])
    scale = [5e-3, 0.3, *np.full(6, 0.5), *np.full(3, 0.1)]

    def residual(theta: np.ndarray) -> np.ndarray:
        return (
            windows.rates(change_vehicle(vehicle, theta[:8]), chosen, theta[8:])
            - windows.rows[chosen][:, :, 1:4]
        ).ravel()

    solution = least_squares(
        residual, start, bounds=(low, high), x_scale=scale, diff_step=1e-2, max_nfev=25
    )
    return solution.x[:8], solution.x[8:]


def draw(
    path: Path,
    windows: Windows,
    chosen: np.ndarray,
    vehicles: dict[str, VehicleParams],
    rest: np.ndarray,
) -> None:
    """Draw the largest of some doublets about each axis: the firmware's rate, and those of vehicles
    under the same commands.
    """
    from visthrow.view import style

    style.use()
    import matplotlib.pyplot as plt

    rates = {name: windows.rates(vehicle, chosen, rest) for name, vehicle in vehicles.items()}
    time = 1e3 * (PERIOD * np.arange(windows.rows.shape[1]) - BEFORE)
    figure, axes = plt.subplots(1, 3, figsize=(9.6, 3.0))
    for axis, name in enumerate(("roll", "pitch", "yaw")):
        sizes = np.where(windows.starts[chosen, 1] == axis, np.abs(windows.starts[chosen, 2]), 0.0)
        at = int(np.argmax(sizes))
        for i, (what, values) in enumerate(rates.items()):
            axes[axis].plot(
                time,
                values[at, :, axis],
                color=style.COLOURS[i + 1],
                lw=1.6,
                ls=("--", "-")[i % 2],
                label=what,
            )
        axes[axis].plot(
            time,
            windows.rows[chosen][at, :, 1 + axis],
            color=style.INK,
            lw=1.0,
            label="Betaflight 4.6",
        )
        axes[axis].set(xlabel="time [ms]", title=name)
    axes[0].set_ylabel("rate [rad/s]")
    axes[2].legend(fontsize=8)
    figure.tight_layout()
    figure.savefig(path, dpi=110)


def make_fitted(policy: str, seed: int) -> HybridWirePlant:
    """The training's plant with the fitted vehicle of ``VISTHROW_FITTED``."""
    experiment = load_policy(policy).experiment
    vehicle = config.load(VehicleParams, os.environ["VISTHROW_FITTED"])
    return HybridWirePlant(dataclasses.replace(experiment, vehicle=vehicle), seed)


def main() -> None:
    """Fly, fit, compare, write."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--out", type=Path, default=Path("out/identify"))
    parser.add_argument("--seconds", type=float, default=60.0)
    parser.add_argument("--policy", default="vision")
    args = parser.parse_args()
    file = args.out / "flight.npz"
    if not file.exists():
        np.savez(file, **fly(args.out, args.seconds))
    flight = dict(np.load(file))
    windows = Windows(flight, args.policy)
    every = np.arange(len(windows.rows))
    fit_windows = every[every % 3 != 2]
    held_out = every[every % 3 == 2]
    shipped = windows.plant.vehicle
    configured = config.load(VehicleParams, config.find("vehicle", "betaflight_sitl"))
    settings = read_blackbox(next((args.out / "run").glob("LOG*")))[0].header
    hover = config.load(HilParams, config.find("hil", "betaflight_sitl")).betaflight.thrust.hover
    weight = 0.25 * windows.plant.total_mass * GRAVITY
    alone = controller_of(
        shipped, settings, weight, calibrated_voltage(shipped, settings, weight, hover)
    )
    named = dataclasses.replace(shipped, controller=alone)
    theta, rest = fit(windows, named, fit_windows)
    fitted = change_vehicle(named, theta)
    (args.out / "vehicle.toml").write_text(config.dumps(fitted))
    figures = {
        "doublets": len(every),
        "stalled": windows.stalled,
        "shipped": windows.miss(shipped, held_out, rest),
        "settings": windows.miss(dataclasses.replace(named, queue=fitted.queue), held_out, rest),
        "configured": windows.miss(
            dataclasses.replace(configured, queue=fitted.queue), held_out, rest
        ),
        "fitted": windows.miss(fitted, held_out, rest),
        "seen": windows.miss(fitted, fit_windows, rest),
        **{
            name: float(v if k < 2 else np.exp(v - 1.0))
            for k, (name, v) in enumerate(zip(NAMES, theta))
        },
    }
    (args.out / "fit.json").write_text(json.dumps(figures, indent=2) + "\n")
    print(json.dumps(figures, indent=2))
    draw(
        args.out / "doublets.png",
        windows,
        held_out,
        {"the training's block": shipped, "fitted": fitted},
        rest,
    )


if __name__ == "__main__":
    main()
