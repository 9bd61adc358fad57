"""The hover controller on a quadrotor with a payload on a massless rigid rope: settles, damps the
swing, recovers.
"""

import itertools

import numpy as np
from numpy.linalg import norm
from numpy.random import default_rng
from numpy.testing import assert_allclose, assert_array_equal
from pytest import approx, mark, raises

from sim import params
from visthrow.common.rotations import matrix_of_quat
from visthrow.onboard.hover import GRAVITY, HoverController, HoverParams
from visthrow.paper.baseline import pendulum_model as pm

VEHICLE, PAYLOAD, LENGTH = 0.214, 0.058, 0.38
"""Vehicle with the rope [kg], ball [kg], mount to the ball's centre [m]: the paper's."""
NOTHING = 1e-6
DELAY, LAGS = 0.022, np.array([0.033, *[1.0 / 30.0] * 3])
"""Of the command, and of the thrust and the body-rate loop [s]."""
PERIOD, STEP = 0.02, 0.005
GOAL = np.array([0.0, 0.0, 2.0])


class LaggingPendulum:
    """Quadrotors with a point mass on a massless rigid rope at their centre of mass, whose thrust
    and rates follow late commands; E of them at once. Without a payload there is next to none.
    """

    def __init__(self, pos_w, payload=PAYLOAD, swing=0.0, delay=DELAY):
        self.model, self.delay = pm.Pendulum(VEHICLE, payload, LENGTH), delay
        self.mass = VEHICLE + payload
        direction = np.array([np.sin(swing), 0.0, -np.cos(swing)])
        self.state, self.acts = pm.hover(self.model, np.atleast_2d(pos_w) + LENGTH * direction)
        self.state[:, pm.DIR] = direction
        self.queue, self.active = [], self.acts

    def advance(self, time: float, command: np.ndarray) -> None:
        """Integrate one control period."""
        self.queue.append((time + self.delay, command))
        for k in range(round(PERIOD / STEP)):
            while self.queue and self.queue[0][0] <= time + k * STEP + 1e-9:
                self.active = self.queue.pop(0)[1]
            self.acts = self.acts + STEP / LAGS * (self.active - self.acts)
            self.state = pm.step(self.model, self.state, self.acts, STEP)

    @property
    def measured(self) -> tuple[np.ndarray, ...]:
        """Position, attitude and velocity of the vehicles, shapes (E, 3), (E, 4) and (E, 3)."""
        direction = self.state[:, pm.DIR]
        pos_w = self.state[:, pm.POS] - LENGTH * direction
        turning = np.cross(self.state[:, pm.RATE], direction)
        return pos_w, self.state[:, pm.QUAT], self.state[:, pm.VEL] - LENGTH * turning

    @property
    def swing(self) -> np.ndarray:
        """Angle of the rope from the vertical [rad], shape (E,)."""
        return np.arccos(np.clip(-self.state[:, pm.DIR][:, 2], -1.0, 1.0))


def fly(plant: LaggingPendulum, duration: float, yaw: float = 0.0, heavier=1.0, **params: float):
    """Fly to GOAL; return times (T,), distances (T, E), swings (T, E), heights (T, E)."""
    controller = HoverController(HoverParams(**params), PERIOD, len(plant.state))
    rows = []
    for k in range(round(duration / PERIOD)):
        plant.advance(k * PERIOD, controller.step(*plant.measured, GOAL, heavier * plant.mass, yaw))
        pos_w = plant.measured[0]
        rows.append((norm(pos_w - GOAL, axis=1), plant.swing, pos_w[:, 2]))
    return (PERIOD * np.arange(1, len(rows) + 1), *map(np.array, zip(*rows)))


def find_settling_time(times, distances, within):
    """Return the time after which the distance (T,) stays within a bound."""
    outside = np.flatnonzero(distances > within)
    return times[outside[-1]] if len(outside) else 0.0


def test_settles_from_half_a_metre_with_the_payload():
    starts = GOAL + 0.5 * np.array(
        [[1, 0, 0], [0, -1, 0], [0, 0, 1], [0, 0, -1], [0.6, 0.64, -0.48]]
    )
    times, distances, swings, _ = fly(LaggingPendulum(starts), 6.0)
    for one in distances.T:
        assert find_settling_time(times, one, 0.10) < 1.6
        assert find_settling_time(times, one, 0.03) < 3.5
    assert distances[-1].max() < 0.01
    assert swings.max() < 0.6, "the payload must not swing up on the way"
    assert swings[-50:].max() < 0.01


@mark.parametrize("delay", [DELAY, DELAY + 0.02])
def test_swing_is_damped_never_amplified(delay):
    start = 0.35
    times, distances, swings, _ = fly(LaggingPendulum(GOAL, swing=start, delay=delay), 5.0)
    peaks = [swings[(times > t) & (times <= t + 1.0)].max() for t in range(5)]
    assert max(peaks) <= start
    assert all(later < 0.7 * earlier for earlier, later in itertools.pairwise(peaks[:4]))
    # With the vehicle held fast a frictionless pendulum would swing for ever: this damping is the
    # controller's.
    assert peaks[4] < 0.02 * start
    assert distances.max() < 0.15


def test_hover_without_the_payload_and_yaw_turns():
    plant = LaggingPendulum(GOAL + [[0.4, -0.3, 0.0]], payload=NOTHING)
    times, distances, _, _ = fly(plant, 6.0, yaw=2.0)
    assert find_settling_time(times, distances[:, 0], 0.03) < 3.5
    rot_wb = matrix_of_quat(plant.measured[1])[0]
    assert np.arctan2(rot_wb[1, 0], rot_wb[0, 0]) == approx(2.0, abs=0.02)


def test_integral_makes_up_for_a_wrong_mass():
    _, distances, _, _ = fly(LaggingPendulum(GOAL), 12.0, heavier=0.95)
    assert distances.max() > 0.05
    assert distances[-1, 0] < 0.01
    _, without, _, _ = fly(LaggingPendulum(GOAL), 4.0, heavier=0.95, integral_gain=0.0)
    assert without[-1, 0] > 0.05


@mark.parametrize("pitch", [1.3, 2.8, np.pi])
def test_recovers_after_a_release_at_any_attitude(pitch):
    plant = LaggingPendulum(GOAL + [[1, 0, 0]], NOTHING)
    plant.state[:, pm.QUAT] = 0.0, np.sin(pitch / 2), 0.0, np.cos(pitch / 2)
    plant.state[:, pm.VEL] = 2.0, 0.0, 1.5
    _, distances, _, heights = fly(plant, 6.0)
    assert distances[-1, 0] < 0.03
    assert heights.min() > 0.8


def test_far_goals_are_approached_at_the_speed_limit():
    params = HoverParams()
    plant = LaggingPendulum(GOAL - [[10.0, 0, 0]])
    controller = HoverController(params, PERIOD)
    for k in range(150):
        plant.advance(k * PERIOD, controller.step(*plant.measured, GOAL, plant.mass))
    assert plant.measured[2][0, 0] == approx(params.max_speed, rel=0.05)


def test_commands_by_hand():
    controller = HoverController(HoverParams(), PERIOD)
    level = np.array([[0.0, 0.0, 0.0, 1.0]])
    still = np.zeros((1, 3))
    hover = controller.step(still, level, still, still, 0.27)
    assert_allclose(hover, [[0.27 * GRAVITY, 0, 0, 0]], atol=1e-12)
    # Goal ahead (+x): lean forward, a positive turn about y (left). Goal to the left (+y): a
    # negative turn about x.
    assert controller.step(still, level, still, np.array([1.0, 0, 0]), 0.27)[0, 2] > 0.5
    assert controller.step(still, level, still, np.array([0, 1.0, 0]), 0.27)[0, 1] < -0.5
    controller.reset()
    # 0.1 m above the goal, integral aside: velocity asked -0.15 m/s, acceleration -0.525 m/s^2.
    low = controller.step(np.array([[0, 0, 0.1]]), level, still, still, 1.0)[0, 0]
    step_of_integral = 3.0 * PERIOD * 0.1
    assert low == approx(GRAVITY - 3.5 * 1.5 * 0.1 - step_of_integral, abs=1e-12)


def test_the_integral_is_limited_alike_both_ways():
    """Vehicles that are held beside their goals for long: mirrored, the same push."""
    goals = 0.1 * np.vstack((-np.eye(3), np.eye(3)))
    level, still = np.tile([0.0, 0.0, 0.0, 1.0], (6, 1)), np.zeros((6, 3))
    controller = HoverController(HoverParams(), PERIOD, 6)
    for _ in range(2000):
        command = controller.step(still, level, still, goals, 0.27)
    pushes = command - [0.27 * GRAVITY, 0.0, 0.0, 0.0]
    assert np.abs(pushes).max(1).min() > 0.05
    assert_allclose(pushes[:3], -pushes[3:], atol=1e-9)


def test_limits_hold_for_any_state():
    params = HoverParams()
    rng = default_rng(0)
    count = 1000
    quats = rng.normal(size=(count, 4))
    quats[0] = (1.0, 0.0, 0.0, 0.0)  # upside down exactly
    controller = HoverController(params, PERIOD, count)
    command = controller.step(
        10 * rng.normal(size=(count, 3)),
        quats,
        10 * rng.normal(size=(count, 3)),
        GOAL,
        0.27,
        7 * rng.normal(size=count),
    )
    assert np.isfinite(command).all()
    assert command[:, 0].min() >= params.min_thrust
    assert command[:, 0].max() <= params.max_thrust
    assert (np.abs(command[:, 1:]) <= params.max_rate).all()


def test_a_batch_equals_singles_and_reset_is_masked():
    rng = default_rng(1)
    state = rng.normal(size=(4, 3)), rng.normal(size=(4, 4)), rng.normal(size=(4, 3))
    goal = state[0] + 0.1
    batch = HoverController(HoverParams(), PERIOD, 4)
    singles = [HoverController(HoverParams(), PERIOD) for _ in range(4)]
    for _ in range(3):
        together = batch.step(*state, goal, 0.27)
        alone = [
            one.step(*(part[i : i + 1] for part in state), goal[i], 0.27)
            for i, one in enumerate(singles)
        ]
        assert_array_equal(together, np.concatenate(alone))
    batch.reset(np.array([True, False, False, False]))
    fresh = HoverController(HoverParams(), PERIOD, 4).step(*state, goal, 0.27)
    after = batch.step(*state, goal, 0.27)
    assert_array_equal(after[0], fresh[0])
    assert not np.array_equal(after[1:], fresh[1:])


@mark.parametrize(
    "wrong",
    [
        {"position_gain": -1.0},
        {"max_rate": (1.0, -1.0, 1.0)},
        {"max_tilt": 1.6},
        {"max_thrust": 0.1},
    ],
)
def test_nonsense_parameters_are_refused(wrong):
    with raises(ValueError, match=next(iter(wrong))):
        HoverParams(**wrong)
    with raises(ValueError, match="period"):
        HoverController(HoverParams(), 0.0)


def test_gravity_on_board_is_the_simulators():
    """It is written twice, because on board there is no simulator to import it from."""
    assert GRAVITY == params.GRAVITY
