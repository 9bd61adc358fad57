"""Which sets of causes are settled by running the simulation again."""

from types import SimpleNamespace

import numpy as np
import pytest

from visthrow.diagnose.likelihood.evidence import Priors
from visthrow.diagnose.select.rivals import rivals

COUNT = 4
WIDE = Priors(np.ones(COUNT), np.full(COUNT, 20.0), np.full(COUNT, -np.inf), np.full(COUNT, np.inf), np.ones(COUNT, dtype=bool))
ALIKE = np.array([1.0, 1.0, 0.0, 0.0])
"""Effects 0 and 1 do the same; 2 and 3 are of other kinds."""


def statistics(alike: np.ndarray, score: float) -> SimpleNamespace:
    """What flights say in which something has this score along ``alike``."""
    return SimpleNamespace(information=np.eye(COUNT) + np.outer(alike, alike), score=score * alike)


def test_a_rival_of_a_single_name_is_found_by_the_statistics_of_the_model_as_it_was():
    """Far from there the derivatives of the name taken may have bent until nothing else is like it."""
    nominal, bent = statistics(ALIKE, 12.0), statistics(np.array([1.0, 0.2, 0.0, 0.0]), 12.0)
    search = SimpleNamespace(
        priors=WIDE, active=[0], nominal=nominal, point=bent, least=5.0, refused={},
        problem=SimpleNamespace(switches=np.zeros(COUNT, dtype=bool)),
    )  # fmt: skip
    assert ([1], pytest.approx(0.0, abs=1e-9)) in rivals(search)
    search.nominal = bent
    assert [1] not in [members for members, _ in rivals(search)]
