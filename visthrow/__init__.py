"""Policies that throw a cable-suspended payload: training, comparison, flight.

Importing the package is cheap: every heavy library is imported by the module that uses it.
"""

import os

__version__ = "0.1.0"

# rsl_rl imports GitPython, which raises at import where no git binary is installed unless it is
# told to stay quiet.
os.environ.setdefault("GIT_PYTHON_REFRESH", "quiet")
