"""The tool spoiled on purpose: for each mutation a test of the default run must fail.

A suite that survives is no test.
"""

from dataclasses import replace

import numpy as np
import pytest

from bench.diagnose import sealed
from bench.worlds.world import Recipe
from tests.diagnose import test_cases
from tests.unit.on_diagnose import test_report as reports
from tests.unit.on_diagnose import test_search as searches
from visthrow.diagnose.likelihood import designs, evidence, marginal
from visthrow.diagnose.likelihood import noise_levels as noise
from visthrow.diagnose.likelihood.evidence import Priors
from visthrow.diagnose.select import held_out, selector
from visthrow.logs.flightlog import FlightLog

pytestmark = pytest.mark.slow


def swapped_names(monkeypatch) -> None:
    """Two effects are called by each other's names."""
    names = {"effect_03": "effect_09", "effect_09": "effect_03"}
    plain = selector.Selector.name
    monkeypatch.setattr(
        selector.Selector, "name", lambda self, j: names.get(plain(self, j), plain(self, j))
    )


def no_latent_forces(monkeypatch) -> None:
    """Gusts are not in the model of the residuals: G is dropped."""
    whole = marginal.gram_of

    def gram(window, floors, channels):
        none = np.zeros(0)
        bare = replace(
            window,
            latent=np.zeros((len(window.residual), 0)),
            latent_block=none.astype(int),
            latent_axis=none.astype(int),
            latent_time=none,
        )
        return whole(bare, floors, channels)

    monkeypatch.setattr(designs, "gram_of", gram)
    monkeypatch.setattr(
        noise, "without_outliers", lambda windows, *_: list(windows)
    )  # gusts would be told by their columns


def no_floors(monkeypatch) -> None:
    """What is not named is not there at all: neither in the evidence, nor in the null worlds, nor
    in what a name must exceed.
    """
    monkeypatch.setattr(evidence, "SPIKE", 1e-3)


def no_bounds(monkeypatch) -> None:
    """Every size is possible."""
    plain = Priors.of

    def of(effects, channels):
        wide = np.full(len(effects), np.inf)
        return replace(plain(effects, channels), low=-wide, high=wide)

    monkeypatch.setattr(Priors, "of", staticmethod(of))


def jackknife_of_one_flight(monkeypatch) -> None:
    """One flight stands for all, many times: intervals of the gain are those of the scatter within
    it.
    """
    plain = held_out.jackknifed

    def one(before, after):
        return plain(np.repeat(before[:1], len(before)), np.repeat(after[:1], len(after)))

    monkeypatch.setattr(held_out, "jackknifed", one)


def truth_in_the_log(monkeypatch) -> None:
    """The recording gives away what is hidden: the seed from which the world was drawn."""
    plain = sealed.flight_log
    monkeypatch.setattr(
        test_cases.cases,
        "flight_log",
        lambda record: FlightLog(plain(record).channels, {"seed": 11}),
    )


def logs_are_clean() -> None:
    """The test of the default run, on its own flights."""
    logs = test_cases.cases.logs_of(Recipe(11, "rod", {"com_y": 1e-3}, **test_cases.SMALL))
    test_cases.test_logs_hold_what_was_measured_and_nothing_of_the_truth(logs)


def one_effect_is_named() -> None:
    """Of the default run."""
    searches.test_one_effect_is_named_with_its_size_and_interval(1.0)


def gains_intervals_hold() -> None:
    """Of the default run."""
    reports.test_intervals_of_the_gain_hold_what_they_promise_and_stay_finite(10)


MUTATIONS = {
    "swapped names": (swapped_names, one_effect_is_named),
    "no latent forces": (no_latent_forces, searches.test_gusts_are_no_causes),
    "no floors": (no_floors, searches.test_causes_at_their_floors_are_not_named),
    "no bounds": (no_bounds, searches.test_an_estimate_stays_within_its_physical_bounds),
    "jackknife of one flight": (jackknife_of_one_flight, gains_intervals_hold),
    "truth in the log": (truth_in_the_log, logs_are_clean),
}
"""What is spoiled, and the test that must fail for it."""


@pytest.mark.parametrize("name", list(MUTATIONS))
def test_a_mutation_is_noticed(name, monkeypatch):
    mutate, guard = MUTATIONS[name]
    guard()
    mutate(monkeypatch)
    with pytest.raises((AssertionError, KeyError)):
        guard()


def test_the_tool_cannot_ask_the_tests(tmp_path):
    """The seed's leak: a tool that imports the tests, where truths are drawn, fails."""
    import subprocess
    import sys

    spoiled = sealed.WITHOUT_TESTS.replace(
        "from visthrow.cli import main", "import bench.worlds.world\nmain = lambda _: 0"
    )
    done = subprocess.run(
        [sys.executable, "-c", spoiled],
        cwd=tmp_path,
        capture_output=True,
        text=True,
        check=False,
        env=test_cases.cases.environment(),
    )
    assert done.returncode != 0
    assert "the tool asked for the tests" in done.stderr
