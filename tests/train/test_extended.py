"""A training in a diagnosed model, and a replay of the data with an identified law."""

from dataclasses import replace

import numpy as np
from pytest import mark

from sim.params import LawParams
from tests.configs import load_experiment
from tests.flown import fly, setting_with
from visthrow.diagnose.apply.patch import extend
from visthrow.diagnose.throw.throw_model import ThrowModel
from visthrow.task import DiagnosedParams
from visthrow.training.trainer import Trainer

LAW = LawParams("payload force", (), "vertical_cross_vel", 0.03)
SMALL = ["ppo.environments=12", "ppo.steps=4", "ppo.hidden=[8]", "ppo.minibatches=2"]


@mark.slow
def test_training_in_an_extended_simulator():
    """Two iterations with effects, plants drawn from what is uncertain of them, and a law."""
    plain = load_experiment("state", SMALL)
    loose = DiagnosedParams(
        ("payload_drag", "com_x", "release_lag"),
        ((1e-8, 0.0, 0.0), (0.0, 1e-8, 0.0), (0.0, 0.0, 1e-6)),
        4,
    )
    experiment = extend(
        plain,
        {
            "payload_drag": 1e-3,
            "com_x": 1e-3,
            "motor_tau_down": 0.01,
            "kick_along": 0.1,
            "wind_x": 0.2,
            "payload_side": 1e-4,
            "rope_elastic": 1e-3,
        },
    )
    trainer = Trainer(replace(experiment, laws=(LAW,), diagnosed=loose), "cpu", 0)
    figures = [trainer.step() for _ in range(2)]
    assert all(np.isfinite(f["value"]) for f in figures)
    assert trainer.algorithm.env.sim.extensions >= {
        "payload_drag",
        "wind",
        "kick",
        "push",
        "payload_spin",
        "compliance",
    }


def after_start(window):
    """Residual of a window, shape (N,), in its noise, once the state at its start is fitted."""
    residual, states = window.residual / window.sigma, window.nuisance / window.sigma[:, None]
    return residual - states @ np.linalg.lstsq(states, residual, rcond=None)[0]


@mark.slow
def test_a_law_that_was_found_flies_the_data_again():
    setting = setting_with({})
    lawful = replace(setting, plant=replace(setting.plant, laws=(LAW,)))
    logs = fly(lawful, noise=0.5, free=1, throws=0, seconds=3.0)
    left = {}
    for name, plant in (("without", setting.plant), ("with", lawful.plant)):
        windows = ThrowModel(logs, plant, only=["rope_length"]).windows({})
        left[name] = np.mean(np.concatenate([after_start(window) for window in windows]) ** 2)
    assert left["with"] < 1.2
    assert left["without"] > 1.5 * left["with"]
