"""Shipped configurations by name."""

from collections.abc import Sequence

from hil.params import HilParams
from visthrow import config
from visthrow.task import Experiment


def load_experiment(name: str, overrides: Sequence[str] = ()) -> Experiment:
    """Load an experiment of ``configs/train``."""
    return config.load(Experiment, config.find("train", name), overrides)


def load_run(name: str, overrides: Sequence[str] = ()) -> HilParams:
    """Load a run of ``configs/hil``."""
    return config.load(HilParams, config.find("hil", name), overrides)
