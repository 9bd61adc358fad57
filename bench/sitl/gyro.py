"""Differences between the blackbox's gyro and the controller block: one throw, from which their
causes are removed one by one.

    python bench/sitl/alone.py python -m bench.sitl.gyro --seeds 100 101

The blackbox records each loop of the firmware; the vehicle is the training's with the firmware's
settings, as `diagnose apply` makes it. The windows' gyro residual after the fit of initial states
is printed as its mean square about x, y and z, in deviations of its noise and of the recording's
steps of 1 deg/s, at the 250 samples a second that `explain` uses. The first line is as `explain`
sees
it: the vehicle behind the firmware in steps of 2 ms, the gyro behind the firmware's filters,
commands at the runner's stamps."""

import argparse
import json
from dataclasses import replace
from pathlib import Path

import numpy as np

from bench.sitl.direct import SETTINGS, throw
from bench.sitl.landings import BASE, DELAY
from hil.params import HilParams
from hil.rehearsal.bridges.betaflight_bridge import SAMPLE
from hil.rehearsal.bridges.betaflight_firmware import Firmware, list_settings
from hil.rehearsal.fake_mocap import FakeMocapParams
from tests.sitl.test_betaflight import program
from visthrow import config
from visthrow.diagnose.apply import patch
from visthrow.diagnose.throw.throw_model import ThrowModel
from visthrow.logs import read
from visthrow.logs.flightlog import FlightLog
from visthrow.logs.joining import join
from visthrow.logs.readers.blackbox.channels import logs_of_blackbox
from visthrow.logs.readers.blackbox.decoder import read_blackbox
from visthrow.onboard.policy import Policy, find_policy
from visthrow.task import Experiment, plant_of
from visthrow.throws.loading import load_policy
from visthrow.throws.wire_plant import HybridMotorPlant

EVERY = 1e-3
"""Of the recorded rates those so far apart are used [s]."""

AT_ONCE = np.radians(2.0)
"""A set-point that comes so near to a command is that command [rad/s]."""


def fly_throw(folder: Path, step: float, seed: int) -> Path:
    """A throw with the vehicle in steps of some length [s], every loop in the blackbox;
    its folder.
    """
    params = config.load(HilParams, config.find("hil", "betaflight_sitl"), [f'policy="{BASE}"'])
    settings = folder / SETTINGS
    where = folder / f"{seed}"
    if not where.exists():
        if not (settings / "eeprom.bin").exists():
            Firmware(program(), settings).set_up(
                list_settings(params.betaflight) | {"blackbox_sample_rate": "1/1"}
            )
        plant = type("Stepped", (HybridMotorPlant,), {"period": step})(
            load_policy(BASE).experiment, seed
        )
        throw(
            program(), where, params, Policy.load(find_policy(BASE)), plant, FakeMocapParams(), seed
        )
    return where


def join_blackbox(where: Path, unfiltered: bool, as_taken: bool) -> FlightLog:
    """The throw's log with its blackbox."""
    (box,) = logs_of_blackbox(path := next(where.glob("LOG*")))
    (run,) = read(where / "run" / "throw-01.npz")
    if unfiltered:
        raw = read_blackbox(path)[0]
        columns = dict(zip(raw.names, raw.main.T))
        values = np.stack([columns[f"gyroUnfilt[{i}]"] for i in range(3)], axis=1)
        box.channels["rate_b"] = replace(box["rate_b"], values=np.radians(values.astype(float)))
    log = join([run, box])
    rate = log["rate_b"]
    setpoint = log["rate_setpoint_b"]
    command = log["command"]
    every = round(EVERY / np.median(np.diff(rate.time)))
    log.channels["rate_b"] = replace(
        rate, time=rate.time[::every], values=rate.values[::every], valid=rate.valid[::every]
    )
    if as_taken:
        time = command.time.copy()
        for k in (
            np.flatnonzero(np.abs(np.diff(command.values[:, 1:], axis=0)).max(axis=1) > AT_ONCE) + 1
        ):
            after = slice(*np.searchsorted(setpoint.time, time[k] + [0.0, 2.0 * DELAY]))
            same = np.all(
                np.abs(setpoint.values[after] - command.values[k, 1:]) < 0.5 * AT_ONCE, axis=1
            )
            time[k] = setpoint.time[after][same.argmax()] - DELAY if same.any() else time[k]
        log.channels["command"] = replace(command, time=np.maximum.accumulate(time))
    return log


def measure_residual(logs: list[FlightLog], box: Path, folder: Path) -> list[float]:
    """Mean square of the windows' gyro residual, in deviations of its noise, shape (3,)."""
    path = config.find("train", BASE)
    hover = config.load(HilParams, config.find("hil", "betaflight_sitl")).betaflight.thrust.hover
    file = folder / "settings.toml"
    file.write_text(
        patch.with_firmware(box, str(path), config.load(Experiment, path), hover, DELAY)
    )
    model = ThrowModel(
        [log.without_estimates() for log in logs],
        plant_of(config.load(Experiment, file)),
        only=["cmd_delay"],
    )
    squares = []
    for w in model.windows({}):
        scaled = w.nuisance * w.nuisance_sd / w.sigma[:, None]
        residual = w.residual / w.sigma
        fitted = np.linalg.solve(np.eye(scaled.shape[1]) + scaled.T @ scaled, scaled.T @ residual)
        squares.append(
            (residual - scaled @ fitted)[w.channel == model.channels.index("rate_b")].reshape(-1, 3)
            ** 2
        )
    return np.concatenate(squares).mean(axis=0).round(2).tolist()


def main() -> None:
    """Fly, remove the causes one by one, print."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seeds", type=int, nargs="+", default=[100, 101])
    parser.add_argument("--out", type=Path, default=Path("out/gyro"))
    args = parser.parse_args()
    for step, *of in (
        (0.002, False, False),
        (0.002, True, False),
        (0.002, True, True),
        (SAMPLE, True, True),
    ):
        folder = args.out / f"{1e3 * step:g}ms"
        throws = [fly_throw(folder, step, seed) for seed in args.seeds]
        residuals = measure_residual(
            [join_blackbox(where, *of) for where in throws], next(throws[0].glob("LOG*")), folder
        )
        print(
            json.dumps(
                {"step_s": step, "unfiltered": of[0], "commands_as_taken": of[1], "left": residuals}
            ),
            flush=True,
        )


if __name__ == "__main__":
    main()
