"""The runner's observation is the training environment's over a long recorded stream, of a state
policy bit for bit; and replays are exact.
"""

import math
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import torch
from numpy.linalg import norm
from numpy.random import default_rng
from numpy.testing import assert_allclose, assert_array_equal
from pytest import mark, param, skip

from hil.control.recording.playback import replay
from hil.control.recording.record import RunRecorder, lines, load_run
from hil.control.runner import OperatorInput, Runner
from hil.links.backends.base import Status
from hil.poses.pose import PAYLOAD, VEHICLE, Pose
from tests.configs import quiet
from tests.contract.test_pilot import ROW
from tests.hil_flight import TICK, Spy, params
from tests.hil_runs import record_run, saved_policy
from visthrow.onboard.observations import layout_of
from visthrow.onboard.pilot import by_own_rule
from visthrow.onboard.policy import Policy, find_policy
from visthrow.training.env import ThrowEnv

CUDA = 1e-5
"""Of an observation on the GPU: another order of additions, other functions of the standard
library.
"""

WIDE = ("gate.max_jump=100.0", "gate.max_speed=1000.0", "gate.max_turn=10.0", "observe=true")
"""Every pose of the stream is taken: it is to be seen, not judged."""


def stream(streams: int, steps: int, seed: int = 0) -> dict[str, np.ndarray]:
    """Random flights, float32, shape (streams, steps, ...): tilts up to upside down, a payload that
    swings all about.
    """
    rng = default_rng(seed)
    time = TICK * np.arange(steps)[:, None]

    def wave(size: float) -> np.ndarray:
        phase, pace = (
            2 * np.pi * rng.random((streams, 1, 3)),
            1.0 + 6.0 * rng.random((streams, 1, 3)),
        )
        return size * rng.random((streams, 1, 3)) * np.sin(phase + pace * time)

    turn = wave(2.5)
    angle = norm(turn, axis=-1, keepdims=True)
    quat = np.concatenate([turn * np.sinc(angle / (2 * np.pi)) / 2, np.cos(angle / 2)], axis=-1)
    pos = wave(1.5) + [0.0, 0.0, 1.4]
    swing = wave(1.0) + [0.0, 0.0, -0.8]
    made = {
        "pos_w": pos,
        "quat_wb": quat / norm(quat, axis=-1, keepdims=True),
        "vel_w": wave(5.0),
        "rate_b": wave(9.0),
        "payload": pos + 0.383 * swing / norm(swing, axis=-1, keepdims=True),
        "goal_w": wave(2.0) * [1, 1, 0],
    }
    return {name: values.astype(np.float32) for name, values in made.items()}


def recorded(flown: dict[str, np.ndarray], folder) -> dict[int, list[Pose]]:
    """The stream as poses that were written to a run's folder and read back."""
    wanted = params("policy=state")
    recorder = RunRecorder(folder, wanted)
    count = flown["pos_w"].shape[0] * flown["pos_w"].shape[1]
    flat = {
        name: values.reshape(count, -1).astype(float).tolist() for name, values in flown.items()
    }
    idle = Runner(wanted, Policy.load(find_policy("state")), Spy()).tick(
        0.0, [], Status(True), OperatorInput()
    )
    for n in range(count):
        at = TICK * n
        views = (flat[name][n] for name in ("pos_w", "quat_wb", "vel_w", "rate_b"))
        vehicle = Pose(at, at, VEHICLE, *map(tuple, views))
        payload = Pose(at, at, PAYLOAD, tuple(flat["payload"][n]))
        recorder.tick(n, [vehicle, payload], Status(True), OperatorInput(), True, idle, {})
    recorder.close({})
    return {line["n"]: line["poses"] for line in load_run(folder)[2]}


def seen_by_the_runner(flown, poses, policy: str) -> tuple[np.ndarray, np.ndarray]:
    """Observations and actions, shape (streams, steps, ...)."""
    runner = Runner(params(f"policy={policy}", *WIDE), Policy.load(find_policy(policy)), Spy())
    streams, steps = flown["pos_w"].shape[:2]
    observations, actions = [], []
    for n in range(streams * steps):
        goal_w = tuple(flown["goal_w"].reshape(-1, 3)[n - n % steps].astype(float).tolist())
        if n % steps == 0:
            runner.params = replace(runner.params, goal_w=goal_w)
            runner.pilot.start()
        decision = runner.tick(TICK * n, poses[n], Status(True), OperatorInput())
        observations.append(decision.observation)
        actions.append(decision.action)
    assert not runner.errors
    shape = (streams, steps, -1)
    return np.array(observations, np.float32).reshape(shape), np.array(actions, np.float32).reshape(
        shape
    )


def shown_by_the_environment(flown, actions: np.ndarray, policy: str, device: str) -> np.ndarray:
    """Observations of the environment for the same states and actions, all streams at once."""
    streams, steps = flown["pos_w"].shape[:2]
    experiment = quiet(policy)
    camera = by_own_rule(Policy.load(find_policy(policy)), experiment.camera)
    env = ThrowEnv(replace(experiment, camera=camera), device, count=streams)
    states, out = env.views.state, []
    env.views.goal_w.copy_(torch.from_numpy(flown["goal_w"][:, 0]))
    states["attached"].fill_(1)
    for t in range(steps):
        for name in ("pos_w", "quat_wb", "vel_w", "rate_b"):
            states[name].copy_(torch.from_numpy(flown[name][:, t]))
        env.views.out["payload_pos_w"].copy_(torch.from_numpy(flown["payload"][:, t]))
        fresh = torch.full((streams,), t == 0, device=device)
        previous = (
            env.start_action.expand(streams, -1) if t == 0 else torch.from_numpy(actions[:, t - 1])
        )
        env.buffers["previous"].copy_(previous)
        out.append(env._observe(fresh)["actor"].cpu().numpy())
    return np.stack(out, axis=1)


def both(
    policy: str, streams: int, steps: int, folder, device: str = "cpu"
) -> tuple[np.ndarray, np.ndarray]:
    flown = stream(streams, steps)
    seen, actions = seen_by_the_runner(flown, recorded(flown, folder), policy)
    return seen, shown_by_the_environment(flown, actions, policy, device)


@mark.parametrize("policy", ["vision", "vision_located"])
def test_poses_of_a_vision_policy(policy, tmp_path):
    seen, shown = both(policy, 20, 60, tmp_path / "a")
    assert seen.shape[:2] == (20, 60)
    layout = layout_of(SimpleNamespace(**Policy.load(find_policy(policy)).contract["observation"]))
    assert_allclose(seen, shown, rtol=ROW, atol=ROW)
    valid = seen[..., layout.columns("validity")]
    assert_array_equal(valid, shown[..., layout.columns("validity")])
    assert 0.1 < valid.mean() < 0.95, "points inside and outside of the field of view"


def test_poses_of_the_state_policy(tmp_path):
    seen, shown = both("state", 10, 20, tmp_path / "a")
    assert_array_equal(seen, shown)


@mark.gpu
@mark.parametrize("policy", ["state", "vision"])
def test_ten_thousand_poses_against_cuda(policy, tmp_path):
    if not torch.cuda.is_available():
        skip("no CUDA device")
    seen, shown = both(policy, 100, 100, tmp_path / "a", "cuda:0")
    assert_allclose(seen, shown, atol=CUDA, rtol=CUDA)


def patchy(rng: np.random.Generator):
    """Poses that are lost, doubled, late, spoiled; for a while none at all."""
    late: list[Pose] = []

    def spoil(time: float, poses: list[Pose]) -> list[Pose]:
        out = late + [p for p in poses if rng.random() > 0.05]
        late.clear()
        if rng.random() < 0.1 and out:
            late.append(replace(out.pop(), arrival=time + TICK))
        if rng.random() < 0.02 and out:
            out.append(replace(out[-1], pos=(math.nan, 0.0, 0.0)))
        if rng.random() < 0.02 and out:
            out.append(out[-1])
        return [] if 0.5 < time % 1.5 < 0.56 else out

    return spoil


RUNS = {
    "drop-outs": {"poses": patchy(default_rng(1)), "seconds": 3.0},
    "operator's abort": {
        "words": lambda t, s: OperatorInput(arm=s == "ready", abort=t > 1.0),
        "seconds": 2.0,
    },
    "mocap gone": {"poses": lambda t, poses: poses if t < 0.9 else [], "seconds": 2.0},
    "autopilot gone": {"status": lambda t: Status(t < 0.9, "silent"), "seconds": 2.0},
    "back after a second": {
        "poses": lambda t, poses: [] if 0.3 < t < 1.6 else poses,
        "seconds": 6.0,
    },
    "late ticks": {"late": lambda t: 0.03 * (math.sin(40.0 * t) > 0.9), "seconds": 2.0},
    "disk full": {"recording": lambda t: t < 0.9, "seconds": 2.0},
}


QUICK = ("states.check_hold=0.2", "states.armed_least=0.1", "states.quiet=0.1", "states.abort=0.3")
SHORT = ("drop-outs", "mocap gone", "late ticks")


@mark.parametrize(
    "name", [name if name in SHORT else param(name, marks=mark.slow) for name in RUNS]
)
def test_any_run_replays_bit_for_bit(name, tmp_path):
    folder = tmp_path / "run"
    record_run(folder, "policy=vision", "observe=true", *QUICK, **RUNS[name])
    found = replay(folder)
    assert found["differences"] == []
    assert found["actions"] > 30


def test_a_run_whose_policy_failed_replays(tmp_path):
    """A policy that puts out nothing but 1: the fence ends it; the run is killed, and its folder
    read as it is.
    """
    record_run(
        tmp_path / "a",
        saved_policy(tmp_path, (1.0, 1.0, -1.0, 1.0, -1.0)),
        *QUICK,
        seconds=3.0,
        close=False,
    )
    found = replay(tmp_path / "a")
    assert found["differences"] == []
    assert "fence" in list(lines(tmp_path / "a" / "ticks.jsonl"))[-1]["reason"]
