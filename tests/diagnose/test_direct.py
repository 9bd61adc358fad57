"""What the diagnosis takes from the keypoints of a world's camera."""

from dataclasses import replace

import numpy as np
from pytest import approx, fixture, mark

from bench.diagnose.sealed import flight_log
from bench.worlds.world import CAMERA_FLOORS, Recipe, fly_recipe, recorded
from sim.effects.setting import Setting
from tests.configs import load_experiment
from visthrow.config.effects import catalogue
from visthrow.diagnose.throw.cutting import cut
from visthrow.diagnose.throw.direct import CameraView
from visthrow.diagnose.throw.recorded_flight import record_of
from visthrow.task import plant_of

SIZE = 5.0
"""Of what is hidden [floors]."""
RECIPE = Recipe(21, "rod", free=2, free_seconds=6.0, throws=2, camera=True)


class Eyes:
    """What the diagnosis takes from the keypoints of a world whose camera has an effect."""

    def __init__(self, flown, effects: dict):
        records = recorded(replace(RECIPE, effects=effects), flown)
        self.logs = [flight_log(record) for record in records]
        experiment = load_experiment("state", ["rope.segments=1"])
        self.setting = Setting(plant_of(experiment), experiment.sensing, camera=experiment.camera)
        flights = [record_of(log, i) for i, log in enumerate(self.logs)]
        release = self.setting.plant.release
        cuts = [
            c
            for i, f in enumerate(flights)
            for c in cut(f, i, release.lag, release.landing_height, True)
        ]
        self.view = CameraView(self.logs, flights, cuts, self.setting)
        self.windows = sorted(self.view.windows)

    def off(self) -> np.ndarray:
        """Measured less predicted, in deviations."""
        seen = [(self.view.samples(w), self.view.predicted(w, self.setting)) for w in self.windows]
        return np.concatenate([(values - told) / sigma for (_, values, sigma), told in seen])

    def column(self, name: str) -> np.ndarray:
        """The same of an effect, a unit of it, by the step that the model takes."""
        step = catalogue()[name].step * catalogue()[name].floor
        other = catalogue()[name].apply(self.setting, step)
        pairs = [
            (
                self.view.predicted(w, other) - self.view.predicted(w, self.setting),
                self.view.samples(w)[2],
            )
            for w in self.windows
        ]
        return np.concatenate([change / sigma for change, sigma in pairs]) / step


@fixture(scope="module")
def flown():
    """Flights; no effect of a camera changes them."""
    return fly_recipe(RECIPE)


@mark.parametrize("name", ["camera_tilt_x", "camera_latency", "camera_focal"])
def test_an_effect_of_the_camera_is_measured_by_keypoints_alone(flown, name):
    """With a track that jumps at the ends of its pieces the latency was a tenth of what
    was hidden.
    """
    truth = SIZE * CAMERA_FLOORS[name]
    assert CAMERA_FLOORS[name] == catalogue()[name].floor
    eyes = Eyes(flown, {name: truth})
    column, off = eyes.column(name), eyes.off()
    assert column @ off / (column @ column) == approx(truth, rel=0.15)
    assert np.var(off - column * truth) < 1.2
