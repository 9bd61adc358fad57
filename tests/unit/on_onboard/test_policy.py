"""The policy file: equal to the training network, refused when damaged or under other
conditions.
"""

import copy
import io
import zipfile

import numpy as np
import torch
from pytest import fixture, mark, raises
from tensordict import TensorDict

from visthrow.common.errors import MismatchError, PolicyError
from visthrow.common.storage import from_json_array, json_array
from visthrow.onboard.policy import FORMAT_VERSIONS, Policy, find_policy

OBS, ACTIONS = 35, 5
EQUAL = 1e-6
"""Bar of the project: the exported network and the training network differ by no more than this."""


CONTRACT = {
    "observation": {"layout": "state", "dimension": OBS, "history": 3},
    "action": {"dimension": ACTIONS, "max_rate": [10.0, 10.0, 4.0]},
    "camera": {"fov_deg": 220.0, "mount": {"position_b": [0.0, 0.0, -0.02]}},
    "release_lag": 0.11,
    "noise": True,
}


def make_actor(activation: str = "elu", normalized: bool = True):
    """Build an rsl_rl actor whose normaliser has seen observations of very different scales."""
    from rsl_rl.models import MLPModel

    torch.manual_seed(0)
    scales = torch.logspace(-3, 2, OBS)
    batch = TensorDict({"policy": torch.randn(512, OBS) * scales + scales}, batch_size=[512])
    spread = {"class_name": "GaussianDistribution", "init_std": 1.0}
    actor = MLPModel(
        batch, {"actor": ["policy"]}, "actor", ACTIONS, [64, 32], activation, normalized, spread
    )
    actor.train()
    actor.update_normalization(batch)
    return actor.eval(), batch


@fixture
def policy() -> Policy:
    actor, _ = make_actor()
    return Policy.from_actor_state(actor.state_dict(), "elu", CONTRACT, {"seed": 3})


@mark.parametrize(
    "activation", ["elu", "relu", "tanh", "selu", "lrelu", "swish", "gelu", "softplus", "mish"]
)
@mark.parametrize("normalized", [True, False])
def test_equal_to_the_training_network(activation, normalized, tmp_path):
    actor, batch = make_actor(activation, normalized)
    Policy.from_actor_state(actor.state_dict(), activation, CONTRACT).save(tmp_path / "p.npz")
    exported = Policy.load(tmp_path / "p.npz").act(batch["policy"])
    trained = actor(batch, stochastic_output=False).detach()
    assert trained.std() > 0.01, "a constant network would prove nothing"
    assert (exported - trained).abs().max() <= EQUAL


def test_round_trip_keeps_everything(policy, tmp_path):
    policy.save(tmp_path / "p.npz")
    loaded = Policy.load(tmp_path / "p.npz")
    obs = torch.randn(7, OBS)
    assert torch.equal(loaded.act(obs), policy.act(obs))
    assert (loaded.contract, loaded.made_by) == (CONTRACT, {"seed": 3})
    assert torch.equal(loaded.act(obs), loaded.act(obs))


def test_observations_of_another_length_are_refused(policy):
    with raises(PolicyError, match=r"\(1, 61\).*expects \(E, 35\)"):
        policy.act(torch.zeros(1, 61))


def test_the_same_conditions_are_accepted(policy):
    now = copy.deepcopy(CONTRACT)
    now["release_lag"] = 0.11 * (1 + 1e-12)
    now["action"]["max_rate"] = (10, 10, 4)
    policy.require(now)


def test_each_difference_is_named_with_both_values(policy):
    now = copy.deepcopy(CONTRACT)
    now["camera"]["mount"]["position_b"][2] = -0.03
    now["observation"]["layout"] = "vision"
    now["noise"] = 1
    del now["release_lag"]
    now["vehicle"] = {"mass": 0.21}
    with raises(MismatchError) as caught:
        policy.require(now)
    message = str(caught.value)
    assert "camera.mount.position_b[2]: trained with -0.02, here -0.03" in message
    assert "observation.layout: trained with 'state', here 'vision'" in message
    assert "noise: trained with True, here 1" in message
    assert "release_lag: trained with 0.11, here nothing" in message
    assert "vehicle.mass: trained with nothing, here 0.21" in message
    assert "max_rate" not in message
    policy.require(now, sections=("action",))


def rewrite(path, change):
    """Return the file's arrays after ``change(arrays, header)``, written back."""
    arrays = dict(np.load(path))
    header = from_json_array(arrays["header"])
    change(arrays, header)
    if "header" in arrays:
        arrays["header"] = json_array(header)
    np.savez(path, **arrays)


@mark.parametrize(
    ("change", "message"),
    [
        (
            lambda a, h: h.update(format_version=FORMAT_VERSIONS[-1] + 1),
            "this program reads versions 1 and 2",
        ),
        (lambda a, h: h.update(format_version=2), "format version 2, but no estimator"),
        (lambda a, h: a.update(estimator_mean=a["normalizer_mean"]), "1, but an estimator"),
        (lambda a, h: h.pop("contract"), "'contract' is None; expected a dict"),
        (lambda a, h: h.update(activation="relux"), "did you mean 'relu'"),
        (lambda a, h: a.pop("layer1_bias"), "no entry 'layer1_bias'"),
        (lambda a, h: a.pop("header"), "no entry 'header'"),
        (lambda a, h: a.pop("normalizer_std"), "no entry 'normalizer_std'"),
        (lambda a, h: a.update(layer1_weight=a["layer1_weight"][:, 1:]), "expected (n, 64)"),
        (
            lambda a, h: a.update(layer2_bias=a["layer2_bias"] * np.nan),
            "layer 2 bias holds numbers that are not finite",
        ),
        (
            lambda a, h: h["contract"]["observation"].update(dimension=69),
            "dimension 69, the network has 35",
        ),
    ],
)
def test_incomplete_or_contradictory_files_are_refused(policy, tmp_path, change, message):
    path = tmp_path / "p.npz"
    policy.save(path)
    rewrite(path, change)
    with raises(PolicyError) as caught:
        Policy.load(path)
    assert message in str(caught.value)
    assert "p.npz" in str(caught.value)


@mark.parametrize("kept", [0.0, 0.1, 0.5, 0.9, 0.99])
def test_truncated_files_are_refused(policy, tmp_path, kept):
    path = tmp_path / "p.npz"
    policy.save(path)
    data = path.read_bytes()
    path.write_bytes(data[: int(kept * len(data))])
    with raises(PolicyError, match="truncated or damaged"):
        Policy.load(path)


def test_other_files_and_missing_files_are_refused(policy, tmp_path):
    policy.save(tmp_path / "there.npz")
    (tmp_path / "text.npz").write_text("mass = 1")
    with raises(PolicyError, match="damaged"):
        Policy.load(tmp_path / "text.npz")
    with raises(PolicyError, match=r"no such file.*there\.npz"):
        Policy.load(tmp_path / "gone.npz")


def test_policies_are_found_by_shipped_name_or_path(policy, tmp_path, monkeypatch):
    monkeypatch.setattr("visthrow.onboard.shipped.SHIPPED", tmp_path / "shipped")
    policy.save(tmp_path / "shipped" / "vision.npz")
    policy.save(tmp_path / "mine.npz")
    assert find_policy("vision") == tmp_path / "shipped" / "vision.npz"
    assert find_policy(tmp_path / "mine.npz") == tmp_path / "mine.npz"
    with raises(PolicyError, match=r"no policy 'vison'.*did you mean 'vision'"):
        find_policy("vison")


def test_pickles_are_never_loaded(tmp_path):
    path = tmp_path / "evil.npz"
    buffer = io.BytesIO()
    np.save(buffer, np.array([{"a": 1}], dtype=object), allow_pickle=True)
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("header.npy", buffer.getvalue())
    with raises(PolicyError, match="pickle"):
        Policy.load(path)


def test_states_of_other_networks_are_refused():
    with raises(
        PolicyError, match=r"got rnn\.weight_ih_l0; expected the state of an rsl_rl MLPModel"
    ):
        Policy.from_actor_state(
            {"rnn.weight_ih_l0": torch.zeros(1), "mlp.0.weight": torch.zeros(1, 1)}, "elu", {}
        )
    with raises(PolicyError, match="no mlp"):
        Policy.from_actor_state({}, "elu", {})
