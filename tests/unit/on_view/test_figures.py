"""Figures hold all that is drawn: nothing reaches over the edge of the picture."""

import cv2
import numpy as np
import pytest

from visthrow.view import figures

WHITE = 250
"""Grey value of an empty edge, of 255."""


@pytest.mark.parametrize("panels", [1, 2, 3, 6])
def test_landings_from_above_are_not_cut_off(panels):
    rng = np.random.default_rng(0)
    drawn = [
        (f"{i} m", [(name, 0.1 * rng.standard_normal((50, 2))) for name in ("state", "vision")])
        for i in range(panels)
    ]
    image = cv2.imdecode(np.frombuffer(figures.scatter(drawn), np.uint8), cv2.IMREAD_GRAYSCALE)
    for edge in (image[:2], image[-2:], image[:, :2], image[:, -2:]):
        assert edge.min() >= WHITE
