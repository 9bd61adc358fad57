"""The hybrid's seam: two solvers behind one interface on the hard throw; a box and two cables fly;
closed forms of each.
"""

import time

import mujoco
import numpy as np
import pytest
import warp as wp

from sim.params import GRAVITY, BodyParams
from sim.reference.bodies import CABLE_STEP, MujocoBodies, rope_and_ball, rope_and_box, two_cables
from sim.seam import FusedChain, SeamSim
from tests.oracle.start import initial_data, vehicle_and_rope
from tests.plants import SCENES, paper_plant
from tests.scenes import load_scene
from tests.simulators import scene_plant
from visthrow.onboard.hover import HoverController, HoverParams

SCENE = load_scene(SCENES / "hard_throw.toml")
BODY, ROPE = vehicle_and_rope(SCENE)
AGREE = 1e-3
"""A thirtieth of the landing error that a policy is to reach [m]; measured 0.14 mm of the ball,
0.19 mm of the vehicle.
"""
SIDES = (0.08, 0.06, 0.05)
"""Of the box [m]."""


def fused(interval: float = 0.002, device: str = "cpu") -> FusedChain:
    bodies = FusedChain(scene_plant(SCENE, 2e-3, "float32"), interval=interval, device=device)
    start = {
        "pos_w": SCENE.pos_w,
        "quat_wb": SCENE.quat_wb,
        "vel_w": SCENE.vel_w,
        "rate_b": SCENE.rate_b,
    }
    rope = {"cable_dir_w": SCENE.cable_dir_w()[None], "cable_vel_w": SCENE.cable_vel_w()[None]}
    bodies.sim.place(**{name: np.array([value]) for name, value in start.items()}, **rope)
    return bodies


def in_mujoco(step: float) -> MujocoBodies:
    bodies = MujocoBodies(rope_and_ball(BODY, ROPE), step=step)
    data = initial_data(bodies.model, SCENE)
    bodies.place(data.qpos, data.qvel)
    return bodies


def hard_throw(bodies) -> tuple[np.ndarray, np.ndarray]:
    """Ends of ball and vehicle [m], shape (3,), by one exchange each 2 ms."""
    wrench = SCENE.schedule[0]
    for _ in range(round(SCENE.duration / 0.002)):
        bodies.root()
        bodies.advance(np.array([wrench.force_b]), np.array([wrench.torque_b]), 0.002)
    return bodies.payload_w()[0], bodies.root().pos_w[0]


def test_two_solvers_agree_on_the_hard_throw():
    """The fused chain at 2 ms, MuJoCo at its own converged step: half of it changes little."""
    ours, theirs, finer = (
        hard_throw(fused()),
        hard_throw(in_mujoco(5e-4)),
        hard_throw(in_mujoco(2.5e-4)),
    )
    for a, b, c in zip(ours, theirs, finer, strict=True):
        assert np.linalg.norm(b - c) < 0.1 * AGREE, "MuJoCo has converged"
        assert np.linalg.norm(a - b) < AGREE


class WarpBodies(MujocoBodies):
    """The same bodies, stepped by MuJoCo Warp in float32."""

    def __init__(self, model, step: float, device: str) -> None:
        super().__init__(model, step=step)
        self.device, self.graphs = device, {}
        self.warp = pytest.importorskip("mujoco_warp", reason="pip install 'visthrow[bench]'")

    def place(self, qpos, qvel) -> None:
        super().place(qpos, qvel)
        data = mujoco.MjData(self.model)
        data.qpos[:], data.qvel[:] = qpos, qvel
        mujoco.mj_forward(self.model, data)
        with wp.ScopedDevice(self.device):
            self.there, self.state = (
                self.warp.put_model(self.model),
                self.warp.put_data(self.model, data, nworld=1),
            )
            self.graphs.clear()  # they hold the arrays of before

    def advance(self, force_b, torque_b, duration) -> None:
        with wp.ScopedDevice(self.device):
            self.state.ctrl.assign(np.concatenate([force_b, torque_b], axis=1).astype(np.float32))
            steps = round(duration / self.step)
            if self.device == "cpu" or steps not in self.graphs:
                self._go_on(steps)  # the first time on a GPU: modules load
                self.graphs[steps] = None
            else:
                if self.graphs[steps] is None:  # what is captured does not run
                    with wp.ScopedCapture() as captured:
                        self._go_on(steps)
                    self.graphs[steps] = captured.graph
                wp.capture_launch(self.graphs[steps])
        super().place(
            self.state.qpos.numpy(), self.state.qvel.numpy()
        )  # whoever looks sees C's copy

    def _go_on(self, steps: int) -> None:
        for _ in range(steps):
            self.warp.step(self.there, self.state)


@pytest.mark.parametrize(
    "device",
    [pytest.param("cpu", marks=pytest.mark.slow), pytest.param("cuda:0", marks=pytest.mark.gpu)],
)
def test_mujoco_warp_ends_the_hard_throw_there_too(capsys, device):
    """At its own converged step; and what it takes beside the fused chain, one vehicle on the same
    device, in one run.
    """
    fused_chain = fused(device=device)
    ours, seconds, ends = hard_throw(fused_chain), {}, {}
    for step in (5e-4, 2.5e-4):
        bodies = WarpBodies(rope_and_ball(BODY, ROPE), step, device)
        data = initial_data(bodies.model, SCENE)
        bodies.place(data.qpos, data.qvel)
        bodies.advance(np.zeros((1, 3)), np.zeros((1, 3)), 0.002)  # compiles
        bodies.place(data.qpos, data.qvel)
        start = time.perf_counter()
        ends[step] = hard_throw(bodies)
        seconds[step] = time.perf_counter() - start
    again = fused(device=device)
    start = time.perf_counter()
    hard_throw(again)
    plain = time.perf_counter() - start
    off = [1e3 * np.linalg.norm(a - b) for a, b in zip(ours, ends[5e-4], strict=True)]
    with capsys.disabled():
        print(
            f"\nMuJoCo Warp, {device}: ball {off[0]:.3f} mm, vehicle {off[1]:.3f} mm;"
            f" {seconds[5e-4] / plain:.1f} times the fused chain"
        )
    for a, b, c in zip(ours, ends[5e-4], ends[2.5e-4], strict=True):
        assert np.linalg.norm(b - c) < 0.1 * AGREE, "it has converged"
        assert np.linalg.norm(a - b) < AGREE


def hovered(bodies, seconds: float = 3.0) -> np.ndarray:
    """Fly the hover controller on bodies, in the vehicle's blocks; places of the payload [m], shape
    (T, 3).
    """
    vehicle = paper_plant().vehicle
    plant = SeamSim(vehicle, bodies)
    home = np.array([0.1, 0.0, 0.0]) + bodies.root().pos_w
    controller, root, places = HoverController(HoverParams(), 0.02), bodies.root(), []
    for _ in range(round(seconds / 0.02)):
        command = controller.step(root.pos_w, root.quat_wb, root.vel_w, home, bodies.total_mass)
        root = plant.step(command)
        places.append(bodies.payload_w()[0])
    assert np.linalg.norm(root.pos_w[0] - home[0]) < 0.05
    assert np.linalg.norm(root.vel_w[0]) < 0.1
    return np.array(places)


@pytest.mark.parametrize("payload", ["ball", "box", "two cables"])
def test_other_payloads_fly_behind_the_same_seam(payload):
    build = {
        "ball": lambda: MujocoBodies(rope_and_ball(BODY, ROPE)),
        "box": lambda: MujocoBodies(rope_and_box(BODY, ROPE, SIDES)),
        "two cables": lambda: MujocoBodies(
            two_cables(BODY, ROPE, SIDES, 0.06, 0.33), step=CABLE_STEP
        ),
    }
    below = {
        "ball": 0.33 + SCENE.ball_offset,
        "box": 0.33 + 0.5 * SIDES[2],
        "two cables": 0.33 + 0.5 * SIDES[2],
    }
    bodies = build[payload]()
    places = hovered(bodies)
    hangs = bodies.root().pos_w[0, 2] + ROPE.mount[2] - places[-50:, 2].mean()
    assert hangs == pytest.approx(below[payload], abs=0.01), (
        "it hangs where the geometry says, swinging a little"
    )


def test_two_cables_turn_as_a_bifilar_pendulum():
    """omega^2 = m g d^2 / (4 I L) for a small turn about the vertical, the mount held still by its
    own inertia.
    """
    heavy = BodyParams(1e4, (1e3, 1e3, 1e3))
    apart, length, turn = 0.06, 0.33, 0.05
    bodies = MujocoBodies(two_cables(heavy, ROPE, SIDES, apart, length), step=CABLE_STEP)
    qpos, qvel = bodies.model.qpos0.copy(), np.zeros(bodies.model.nv)
    qpos[10:14] = np.cos(turn / 2), 0.0, 0.0, np.sin(turn / 2)
    bodies.place(qpos, qvel)
    hold = np.array([[0.0, 0.0, bodies.total_mass * GRAVITY]])
    angles = []
    for _ in range(1000):
        bodies.advance(hold, np.zeros((1, 3)), 0.002)
        quat = bodies._batch.qpos[0, 10:14]
        angles.append(2.0 * np.arctan2(quat[3], quat[0]))
    crossings = np.flatnonzero(np.diff(np.sign(angles)) != 0)
    half_period = 0.002 * float(np.diff(crossings).mean())
    inertia = ROPE.payload_mass / 12.0 * (SIDES[0] ** 2 + SIDES[1] ** 2)
    expected = np.sqrt(ROPE.payload_mass * GRAVITY * apart**2 / (4.0 * inertia * length))
    assert np.pi / half_period == pytest.approx(expected, rel=0.02)


def test_a_cable_pulls_or_is_slack():
    """In free fall together with the vehicle nothing is stretched; under thrust the cables are as
    long as they are.
    """
    bodies = MujocoBodies(two_cables(BODY, ROPE, SIDES, 0.06, 0.33), step=CABLE_STEP)
    lift = np.array([[0.0, 0.0, 1.5 * bodies.total_mass * GRAVITY]])
    bodies.advance(lift, np.zeros((1, 3)), 0.2)
    np.testing.assert_allclose(bodies.tendon_length[0], 0.33, atol=2e-3)
    bodies.advance(-0.5 * lift, np.zeros((1, 3)), 0.05)
    assert (bodies.tendon_length[0] < 0.33).all(), "the vehicle falls faster than the box"


def test_the_seam_names_what_it_cannot_do():
    with pytest.raises(ValueError, match=r"across body z of 1 N; expected 0"):
        fused().advance(np.array([[1.0, 0.0, 3.0]]), np.zeros((1, 3)), 0.002)
    with pytest.raises(ValueError, match="no whole number of steps"):
        in_mujoco(5e-4).advance(np.zeros((1, 3)), np.zeros((1, 3)), 0.0013)
    with pytest.raises(ValueError, match="whole number of substeps"):
        SeamSim(paper_plant().vehicle, in_mujoco(5e-4), substep=0.003)


@pytest.mark.slow
def test_what_the_seam_costs(capsys):
    """Prints environment steps a second of both solvers in one run; the fused chain is the faster
    one.
    """
    found = {}
    for name, make in (
        ("fused", lambda: FusedChain(scene_plant(SCENE, 2e-3, "float32"), 256)),
        ("mujoco", lambda: MujocoBodies(rope_and_ball(BODY, ROPE), 256)),
    ):
        bodies, lift = make(), np.array([[0.0, 0.0, 2.7]])
        bodies.advance(lift, np.zeros((1, 3)), 0.002)
        best = 0.0
        for _ in range(3):
            start, steps = time.perf_counter(), 0
            while time.perf_counter() - start < 1.0:
                bodies.root()
                bodies.advance(lift, np.zeros((1, 3)), 0.002)
                steps += 256
            best = max(best, steps / (time.perf_counter() - start) / 10.0)
        found[name] = best
    with capsys.disabled():
        print(
            f"\nseam, one core, 256 vehicles: {found}, ratio {found['fused'] / found['mujoco']:.1f}"
        )
    assert found["fused"] > found["mujoco"]
