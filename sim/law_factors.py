"""The factors of laws outside the catalogue, which the kernels and the diagnosis make alike."""

import tomllib
from pathlib import Path

LAW_FACTORS = tomllib.loads(Path(__file__).with_suffix(".toml").read_text(encoding="utf-8"))
"""``groups`` of quantities; ``scalars`` and, by block, ``vectors``: name -> symbol, unit, quantity
and what it is made of.
"""
