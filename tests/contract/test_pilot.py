"""The pilot shows the actor what the training environment showed it, with a batch of one: bit for
bit, keypoints and what follows from them to `ROW`.
"""

from dataclasses import replace

import numpy as np
import torch
from numpy.testing import assert_allclose, assert_array_equal
from pytest import mark, raises

from tests.configs import load_experiment, quiet
from visthrow.common.errors import MismatchError, PolicyError
from visthrow.onboard.pilot import Pilot
from visthrow.onboard.policy import Policy
from visthrow.task import Experiment, contract_of
from visthrow.throws.loading import load_policy
from visthrow.training.env import ThrowEnv

STEPS = 120

ROW = 1e-6
"""The pilot projects keypoints in float64, the environment in float32."""


def random_policy(experiment: Experiment) -> Policy:
    """A small network with outputs all over the range, release included, that reacts to every
    input.
    """
    torch.manual_seed(0)
    contract = contract_of(experiment)
    width = contract["observation"]["dimension"]
    weights = (0.5 * torch.randn(16, width), 0.8 * torch.randn(5, 16))
    bias = torch.tensor([0.2, 0.0, 0.0, 0.0, -0.5])
    return Policy(weights, (torch.randn(16), bias), "tanh", contract)


@mark.parametrize("name", ["state", "vision", "vision_ideal"])
def test_observation_and_command_equal_the_environments(name):
    experiment, count = quiet(name), 3
    policy = random_policy(experiment)
    env = ThrowEnv(experiment, "cpu", seed=1, count=count)
    pilots = [Pilot(policy, experiment.camera) for _ in range(count)]
    shown = env.get_observations()["actor"]
    starts = released = 0
    for _ in range(STEPS):
        state, goal = (
            {key: value.numpy() for key, value in env.views.state.items()},
            env.views.goal_w.numpy(),
        )
        payload = env.views.out["payload_pos_w"].numpy()
        outs = []
        for e, pilot in enumerate(pilots):
            one = slice(e, e + 1)
            views = (state[key][one] for key in ("pos_w", "quat_wb", "vel_w", "rate_b"))
            outs.append(pilot.act(*views, payload[one], goal[one], state["attached"][one]))
        observed = np.concatenate([out.observation for out in outs])
        assert_allclose(observed, shown.numpy(), rtol=0.0, atol=0.0 if name == "state" else ROW)
        action = torch.from_numpy(np.concatenate([out.action for out in outs]))
        observations, _, done, _ = env.step(action)
        shown = observations["actor"].clone()
        going = done.numpy() == 0
        for sent, expected in (("command", env.views.command), ("release", env.views.release)):
            ours = np.concatenate([getattr(out, sent) for out in outs])
            assert_array_equal(ours[going], expected.numpy()[going])
        released += int(env.last["released"].sum())
        for e in torch.nonzero(done).flatten().tolist():
            pilots[e].start()
            starts += 1
    assert starts > 3, "episodes must end and start within the test"
    assert released > 0, "some must end by a release"


def test_a_rehearsal_changes_nothing():
    """The shipped policy has a memory: a rehearsal must not move it."""
    policy = load_policy("vision").policy
    camera = load_experiment("vision").camera
    rehearsed, plain = Pilot(policy, camera), Pilot(policy, camera)
    rng = np.random.default_rng(4)
    for _ in range(30):
        views = [rng.normal(0.0, 0.3, (1, 3)) for _ in range(5)]
        quat = np.array([[0.1, -0.1, 0.0, 1.0]]) / np.sqrt(1.02)
        shown = (views[0] + [0.0, 0.0, 1.5], quat, views[1], views[2], views[3], views[4])
        rehearsed.rehearse()
        rehearsed.rehearse()
        ours, other = rehearsed.act(*shown), plain.act(*shown)
        for name in ("action", "command", "observation"):
            assert_array_equal(getattr(ours, name), getattr(other, name))


def test_a_policy_keeps_its_rule_for_what_is_out_of_view(tmp_path):
    camera = load_experiment("vision").camera
    assert camera.noise.invalid_reads == "zero"
    older = random_policy(load_experiment("vision_ideal", ["camera.noise.invalid_reads=edge"]))
    path = tmp_path / "older.npz"
    older.save(path)
    assert Pilot(Policy.load(path), camera).camera.edge_reads
    assert load_policy(path, "vision_ideal").experiment.camera.noise.invalid_reads == "edge"
    with raises(MismatchError, match="invalid_reads: trained with 'edge', here 'zero'"):
        load_policy(path, "vision_ideal", ["camera.noise.invalid_reads=zero"])


def test_another_camera_is_refused():
    experiment = quiet("vision")
    other = replace(experiment.camera, goal_side=0.3)
    with raises(MismatchError, match=r"goal_side: trained with 0\.25, here 0\.3"):
        Pilot(random_policy(experiment), other)
    with raises(PolicyError, match="needs a camera"):
        Pilot(random_policy(experiment))


def test_wrong_shapes_and_contracts_are_refused():
    experiment = quiet("state")
    policy = random_policy(experiment)
    still = np.zeros((1, 3))
    with raises(ValueError, match=r"pos_w has shape \(2, 3\); expected \(1, 3\)"):
        Pilot(policy).act(np.zeros((2, 3)), np.array([[0, 0, 0, 1.0]]), still, still, still, still)
    contract = {key: value for key, value in policy.contract.items() if key != "release"}
    with raises(PolicyError, match="release"):
        Pilot(replace(policy, contract=contract))
    with raises(PolicyError, match="no camera"):
        Pilot(policy).see(still, np.array([[0, 0, 0, 1.0]]), still, still)
