"""The fake's throw without a wire: the same bits for the same seed, poses as old as
over the wire.
"""

import numpy as np
import pytest

from bench.direct import Direct, scored
from hil.params import HilParams
from hil.rehearsal.fake_mocap import FakeMocapParams, Mocap
from tests.hil_flight import simple_policy
from tests.level import LevelPlant
from visthrow import config
from visthrow.common.errors import ConfigError
from visthrow.onboard.actions import hover_action

HOVER = hover_action(9.81 * 0.272, 14.0)[0]


class Landing(LevelPlant):
    """Lands half a second after its release."""

    @property
    def landing(self):
        down = self.released is not None and self.time > self.released + 0.5
        return {
            "landing_w": [1.97, 0.04, 0.04] if down else None,
            "landing_time": self.time if down else None,
            "separation_time": None,
        }


def made(seed: int, action=(HOVER, 0.0, 0.0, 0.0, 1.0)) -> Direct:
    params = config.load(HilParams, config.find("hil", "fake"), ["policy=state"])
    return Direct(Landing(), simple_policy(action), params, FakeMocapParams(), seed)


def flown(seed: int, action=(HOVER, 0.0, 0.0, 0.0, 1.0)):
    direct, ages = made(seed, action), []
    decide = direct._decide

    def watched(now, throwing, latch):
        gate = direct._tracks["vehicle"].gate
        if gate.last is not None:
            ages.append(now - gate.last.stamp)
        return decide(now, throwing, latch)

    direct._decide = watched
    return direct.throw(), direct.params, direct.plant, np.array(ages)


def test_a_throw_is_scored_by_the_plants_landing():
    report, params, plant, _ = flown(0)
    assert plant.released == pytest.approx(report["latch"], abs=1e-9)
    assert report["latch"] - report["start"] < 0.021
    found = scored(report, params, report["start"])
    assert found["error"] == pytest.approx(0.05)
    assert found["duration"] == pytest.approx(0.5 + report["latch"] - report["start"], abs=0.01)
    assert scored({"landing_w": None, "landing_time": None}, params, 0.0) == {
        "error": None,
        "duration": None,
    }


def test_the_same_seed_gives_the_same_commands():
    (first, *_), (second, *_) = flown(3), flown(3)
    assert first == second


def test_a_policy_that_never_releases_ends():
    report, params, _, _ = flown(0, (HOVER, 0.0, 0.0, 0.0, -1.0))
    assert (report["latch"], scored(report, params, 0.0)["error"]) == (None, None)


def test_motion_capture_of_a_seed():
    plant, out = LevelPlant(), []
    mocap = Mocap(FakeMocapParams(loss=0.2), 5)
    for _ in range(400):
        if mocap.due(plant.time):
            out += mocap.measure(plant.time, plant.state)
        plant.step((0.0,) * 4, False)
    vehicle = np.array([p.pos for p in out if p.body == "vehicle"])
    assert 0.7 < len(vehicle) / 200 < 0.9
    assert np.std(vehicle - plant.home_w) == pytest.approx(1e-3, rel=0.1)
    angles = np.array([2 * np.arccos(min(1.0, p.quat[3])) for p in out if p.body == "vehicle"])
    assert np.sqrt(np.mean(angles**2)) == pytest.approx(np.sqrt(3) * np.radians(0.2), rel=0.1)
    assert all(p.arrival == pytest.approx(p.stamp + 0.01) for p in out)
    for wrong in ({"rate": 0.0}, {"loss": 1.0}, {"latency": -0.1}):
        with pytest.raises(ConfigError, match=f"{next(iter(wrong))} is"):
            FakeMocapParams(**wrong)
