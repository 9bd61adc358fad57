"""Logs of flights in the project's own simulator, for tests of what replays them: free flights and
throws, 200 Hz.
"""

from collections import defaultdict
from dataclasses import replace

import numpy as np
from numpy.random import default_rng
from scipy.spatial.transform import Rotation

from bench.worlds.pilot import FreeFlight, Throw, Tracker
from sim.effects.effect import apply
from sim.effects.setting import Setting
from sim.hybrid import HybridSim
from tests.plants import EVERYTHING, paper_plant
from visthrow.config.effects import choose_effects
from visthrow.logs.flightlog import Channel, FlightLog
from visthrow.throws.plants import fly_payloads

FINE = 5e-4  # integration step of the flights [s]
TICK = 0.005  # between samples [s]
RATIO = 4  # samples a command
NOISE = {"pos_w": 5e-4, "quat_wb": np.radians(0.2), "payload_pos_w": 8e-4}


def setting_with(theta: dict[str, float]) -> Setting:
    """The paper's plant with effects of the catalogue."""
    return apply(choose_effects(theta), Setting(paper_plant()), theta)


def fly(
    setting: Setting,
    seed: int = 0,
    free: int = 2,
    throws: int = 2,
    seconds: float = 4.0,
    noise: float = 1.0,
    lost: float = 0.0,
    used: float = 0.2,
) -> list[FlightLog]:
    """Fly a plant and record it as motion capture would.

    Args:
        setting: plant and sensors; delays of sensors are not simulated here, frames and markers are
            not either.
        seed: of references and noise.
        free: number of free flights.
        throws: of throws.
        seconds: of a free flight [s].
        noise: times :data:`NOISE`.
        lost: share of the commands that never arrive, where the last one stays; the log holds what
            was sent.
        used: fraction of the battery's charge at the start.
    """
    rng = default_rng(seed)
    references = [FreeFlight(rng) for _ in range(free)]
    references += [
        Throw(rng, speed, rng.uniform(-np.pi, np.pi)) for speed in np.linspace(6.0, 10.0, throws)
    ]
    plant = setting.plant
    steps = replace(plant.sim, control_period=TICK, substep=FINE, precision="float64")
    sim = HybridSim(replace(plant, sim=steps), len(references), extensions=EVERYTHING)
    known = paper_plant()
    pilot = Tracker(
        references, known.vehicle.body.mass, known.rope.payload_mass + known.rope.rope_mass, rng
    )
    sim.place(np.array([r.at(0.0)[0] for r in references]), battery_used=used)
    tracks: dict[str, list] = defaultdict(list)
    separated = np.full(len(references), np.inf)
    left, link, arrived = [None] * len(references), default_rng([seed, 1]), None
    ticks = round(max(seconds, 2.6) / TICK)
    for k in range(ticks):
        t = k * TICK
        if k % RATIO == 0:
            quat = sim.get("quat_wb")[:, [3, 0, 1, 2]]
            command = pilot.command(
                t, sim.get("pos_w"), sim.get("vel_w"), quat, sim.get("attached") != 0
            )
            tracks["command"].append(command)
            tracks["voltage"].append(sim.get("voltage"))
            gone = link.random((len(references), 1)) < lost
            arrived = command if arrived is None else np.where(gone, arrived, command)
            sim.set_command(arrived, [t >= r.release - 1e-9 for r in references])
        sim.step()
        ball = sim.get("payload_pos_w").copy()
        for e in np.flatnonzero(sim.get("separated")):
            separated[e] = t + sim.get("separation_time")[e]
            left[e] = (sim.get("payload_pos_w")[e], sim.get("payload_vel_w")[e])
        for e in np.flatnonzero(np.isfinite(separated)):
            gone = np.array([t + TICK - separated[e]])
            ball[e] = fly_payloads(plant.rope, plant.air, *(x[None] for x in left[e]), gone)[0][0]
        tracks["payload_pos_w"].append(ball)
        for name in ("pos_w", "quat_wb"):
            tracks[name].append(sim.get(name))
    times = TICK * np.arange(1, ticks + 1)
    logs = []
    for e, reference in enumerate(references):
        track = {name: np.array(values)[:, e] for name, values in tracks.items()}
        logs.append(_log(setting, reference, track, times, noise, rng))
    return logs


def _log(
    setting: Setting, reference, track: dict, times: np.ndarray, noise: float, rng
) -> FlightLog:
    x, com = setting.sensing, np.array(setting.plant.vehicle.body.com)
    turned = Rotation.from_quat(track["quat_wb"])
    frame, marker = Rotation.from_rotvec(x.frame_tilt), Rotation.from_rotvec(x.marker_rotation)
    pos = frame.apply(track["pos_w"] + turned.apply(np.array(x.marker_offset) - com)) * (
        1 + x.scale
    )
    ball = frame.apply(track["payload_pos_w"] + np.array(x.payload_offset)) * (1 + x.scale)
    markers = frame * turned * marker
    count = len(times)
    pos = pos + noise * NOISE["pos_w"] * rng.normal(size=pos.shape)
    markers = markers * Rotation.from_rotvec(noise * NOISE["quat_wb"] * rng.normal(size=(count, 3)))
    ball = ball + noise * NOISE["payload_pos_w"] * rng.normal(size=ball.shape)
    flying = track["payload_pos_w"][:, 2] > setting.plant.release.landing_height
    flying = np.logical_and.accumulate(flying)
    commands = track["command"]
    sent = TICK * RATIO * np.arange(len(commands))
    channels = {
        "pos_w": Channel(times + x.vehicle_delay, pos, "m", "world"),
        "quat_wb": Channel(times + x.vehicle_delay, markers.as_quat(), "1", "world"),
        "payload_pos_w": Channel(times + x.payload_delay, ball, "m", "world", flying),
        "command": Channel(sent, commands, "N, rad/s", "body"),
        "battery_voltage": Channel(sent, track["voltage"], "V"),
        "release_command": Channel(sent, (sent >= reference.release - 1e-9).astype(float), "1"),
    }
    return FlightLog(channels, {})
