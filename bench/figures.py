"""Figures of measurements: bounds of ratios, lines of a file, what is a number."""

import json
import math
from pathlib import Path
from typing import Any

import numpy as np


def bootstrap_upper(
    ratio_of: np.ndarray, level: float = 0.9, draws: int = 20_000, seed: int = 0
) -> tuple[float, float]:
    """Ratio of the means of two columns of pairs, and its one-sided upper bound by bootstrap.

    Args:
        ratio_of: shape (N, 2).
        level: of the bound.
        draws: bootstrap samples. seed: of them.
    """
    rng = np.random.default_rng(seed)
    means = ratio_of[rng.integers(len(ratio_of), size=(draws, len(ratio_of)))].mean(axis=1)
    value = float(ratio_of[:, 0].mean() / ratio_of[:, 1].mean())
    return value, float(np.quantile(means[:, 0] / means[:, 1], level))


def json_lines(path: Path) -> list[dict[str, Any]]:
    """Values of a file of JSON lines, without a truncated last line; none where the file is
    missing.
    """
    values = []
    for row in path.read_text(encoding="utf-8").splitlines() if path.is_file() else ():
        try:
            values.append(json.loads(row))
        except ValueError:
            break
    return values


def finite(value: float | None) -> bool:
    """Whether a figure exists and is finite."""
    return value is not None and math.isfinite(value)
