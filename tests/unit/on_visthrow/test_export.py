"""Exported networks give the policy's actions: ONNX by ONNX's own evaluator, C by a compiler."""

import ctypes
import subprocess

import numpy as np
import torch
from numpy.testing import assert_allclose, assert_array_equal
from pytest import mark

from tests.commands import run_command
from visthrow.cli.gymnasium_env import SingleThrowEnv, ThrowVectorEnv
from visthrow.onboard.policy import Policy, find_policy

THROWS, STEPS = 100, 5
"""Throws side by side, each with its memory carried on."""
TOLERANCE = 1e-5
"""float32 sums in another order; actions are of the size of 1."""
SHIPPED = ("state", "vision", "any")
"""The second one has a memory."""
FLAGS = ["-std=c99", "-O1", "-Wall", "-Wextra", "-Werror", "-shared", "-fPIC"]


POLICIES = {name: Policy.load(find_policy(name)) for name in SHIPPED}


def rollout(policy: Policy) -> tuple[np.ndarray, np.ndarray]:
    """Return observations (T, E, D) about the policy's own and its actions (T, E, A)."""
    generator = torch.Generator().manual_seed(11)
    shape = (STEPS, THROWS, policy.obs_dim)
    obs = 1.5 * torch.randn(shape, generator=generator)
    first = policy if policy.estimator is None else policy.estimator  # what the input meets first
    if first.mean is not None:
        obs = first.mean + first.std * obs
    memory, actions = policy.begin(THROWS), []
    for row in obs:
        action, memory = policy.step(row, memory)
        actions.append(action)
    return obs.numpy(), torch.stack(actions).numpy()


@mark.parametrize("name", POLICIES)
def test_onnx_gives_the_policys_actions(name, tmp_path):
    from onnx.reference import ReferenceEvaluator

    from visthrow.cli.export.onnx_file import write_onnx

    policy = POLICIES[name]
    write_onnx(policy, tmp_path / "policy.onnx")
    session = ReferenceEvaluator(str(tmp_path / "policy.onnx"))
    obs, expected = rollout(policy)
    memory = policy.begin(THROWS).numpy()
    for row, action in zip(obs, expected, strict=True):
        inputs = {"obs": row} | ({"memory": memory} if policy.estimator else {})
        outputs = session.run(None, inputs)
        memory = outputs[1] if policy.estimator else memory
        assert_allclose(outputs[0], action, rtol=0.0, atol=TOLERANCE)


@mark.parametrize("name", ["state", "vision"])
def test_c_gives_the_policys_actions_without_a_heap(name, tmp_path):
    from visthrow.cli.export.c_source import write_c

    policy = POLICIES[name]
    source, library = tmp_path / "policy.c", tmp_path / "policy.so"
    write_c(policy, source)
    subprocess.run(["gcc", *FLAGS, str(source), "-o", str(library), "-lm"], check=True)
    symbols = subprocess.run(["nm", "-D", str(library)], capture_output=True, text=True, check=True)
    assert "malloc" not in symbols.stdout
    function = ctypes.CDLL(str(library)).visthrow_policy
    floats = np.ctypeslib.ndpointer(np.float32, flags="C_CONTIGUOUS")
    function.argtypes, function.restype = [floats, floats, floats], None
    obs, expected = rollout(policy)
    memories = np.zeros((THROWS, max(policy.begin(1).shape[1], 1)), np.float32)
    actions = np.empty_like(expected)
    for t in range(STEPS):
        for e in range(THROWS):
            function(np.ascontiguousarray(obs[t, e], np.float32), memories[e], actions[t, e])
    assert_allclose(actions, expected, rtol=0.0, atol=TOLERANCE)


def test_the_command_writes_by_the_ending_and_refuses_others(tmp_path, capsys, refused):
    assert run_command(f"policy export state --out {tmp_path}/p.c") == 0
    assert (tmp_path / "p.c").read_text().startswith("/* Network of a visthrow policy")
    assert "35 observations, 5 actions" in capsys.readouterr().out
    refused(
        f"policy export state --out {tmp_path}/p.tflite",
        message="expected a name that ends in .onnx or .c",
    )
    assert not (tmp_path / "p.tflite").exists()


def test_gymnasiums_checker_passes():
    from gymnasium.utils.env_checker import check_env

    check_env(SingleThrowEnv("state"), skip_render_check=True)


def test_a_batch_of_throws_ends_and_starts_anew():
    env = ThrowVectorEnv("state", count=8, seed=3)
    first, _ = env.reset(seed=3)
    assert first.shape == env.observation_space.shape
    again, _ = env.reset(seed=3)
    assert_array_equal(first, again)
    fall = np.tile(np.float32([-1.0, 0.0, 0.0, 0.0, -1.0]), (8, 1))
    for _ in range(100):
        _, _, terminated, truncated, infos = env.step(fall)
        if terminated.any():
            break
    assert terminated.any(), "vehicles without thrust must crash within two seconds"
    assert not truncated.any()
    assert not infos["final_info"]["released"][terminated].any()
