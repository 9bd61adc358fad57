"""A camera's keypoints: the worlds' camera against the package's, and what the diagnosis takes from
a detector's marks.
"""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import torch
from pytest import approx, fixture, mark

from bench.diagnose.sealed import flight_log
from bench.worlds.camera import CENTRE, FOCAL, HALF_VIEW, marks
from bench.worlds.numbers import hide
from bench.worlds.turns import matrix
from bench.worlds.world import CAMERA_FLOORS, Recipe, fly_recipe, recorded
from camera.keypoints import KeypointCamera, keypoints
from sim.effects.setting import Setting
from tests.configs import load_experiment
from visthrow.config.effects import catalogue
from visthrow.diagnose.throw.cutting import cut
from visthrow.diagnose.throw.direct import CameraView
from visthrow.diagnose.throw.recorded_flight import record_of
from visthrow.task import plant_of

BOX = 0.5
"""Largest error of the package's box, which takes the ball's outline to second order [px]."""
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


def test_the_worlds_camera_sees_what_the_packages_sees():
    rng, count = np.random.default_rng(0), 300
    quat = rng.normal(size=(count, 4)) * [0.0, 0.3, 0.3, 0.8] + [1.0, 0.0, 0.0, 0.0]
    quat /= np.linalg.norm(quat, axis=1, keepdims=True)
    pos = rng.uniform(-1.0, 1.0, (count, 3)) + [0.0, 0.0, 2.0]
    ball = pos + rng.normal(size=(count, 3)) * 0.1 + [0.0, 0.0, -0.38]
    goal = np.array([1.0, 0.5, 0.0])
    flight = SimpleNamespace(
        time=np.arange(count) * 1e-3, pos=pos[None], quat=quat[None], ball=ball[None]
    )
    found, seen = marks(flight, 0, flight.time, goal, hide({}))

    lens = KeypointCamera(load_experiment("state").camera, dtype=torch.float64)
    arrays = pos, matrix(quat), np.tile(goal, (count, 1)), ball
    points, valid = (
        x.numpy()
        for x in keypoints(lens, *[torch.from_numpy(np.ascontiguousarray(x)) for x in arrays])
    )
    pixels = points * FOCAL * HALF_VIEW + CENTRE
    np.testing.assert_array_equal(seen[:, :4], valid[:, :4])
    np.testing.assert_allclose(pixels[:, :4][seen[:, :4]], found[:, :4][seen[:, :4]], atol=1e-9)
    assert seen[:, 4:].mean() > 0.9
    assert 1e-6 < np.abs(pixels[:, 4:] - found[:, 4:])[seen[:, 4:]].max() < BOX


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
