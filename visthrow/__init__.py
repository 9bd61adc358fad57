"""Policies that throw a cable-suspended payload: training, comparison, flight.

Importing the package is cheap: every heavy library is imported by the module that uses it.
"""

import importlib
import os
from typing import Any

__version__ = "0.1.0"

# rsl_rl imports GitPython, which raises at import where no git binary is installed unless it is
# told to stay quiet.
os.environ.setdefault("GIT_PYTHON_REFRESH", "quiet")

__all__ = ["compare", "diagnose", "fly", "train"]


def __getattr__(name: str) -> Any:
    """Import a command of :mod:`visthrow.cli.api` when it is first used."""
    if name not in __all__:
        raise AttributeError(f"module 'visthrow' has no attribute '{name}'")
    return getattr(importlib.import_module("visthrow.cli.api"), name)
