"""Shipped configurations by name."""

from collections.abc import Sequence

from hil.params import HilParams
from visthrow import config
from visthrow.task import Experiment, load_experiment

QUIET = (
    *("task.noise.observation_step=0.0", "task.noise.observation_bias=0.0"),
    *("task.noise.command_step=0.0", "task.noise.command_bias=0.0"),
    *("task.observation.latency=[0.0,0.0]", "task.observation.latency_jitter=0.0"),
    *("camera.noise.step_std=0.0", "camera.noise.bias_std=0.0", "camera.noise.scale_std=0.0"),
    *("camera.noise.latency=0.0", "camera.noise.drop_probability=0.0"),
    *("camera.noise.wrong_probability=0.0", "camera.noise.held_probability=0.0"),
    *("camera.mount.rotation_error_std=0.0", "camera.mount.position_error_std=0.0"),
)
"""Overrides that make measurements exact and current, and commands arrive as sent."""


def quiet(name: str, *overrides: str) -> Experiment:
    """Load an experiment without noise, latency and errors of the camera."""
    return load_experiment(name, [*QUIET, *overrides])


def load_run(name: str, overrides: Sequence[str] = ()) -> HilParams:
    """Load a run of ``configs/hil``."""
    return config.load(HilParams, config.find("hil", name), overrides)
