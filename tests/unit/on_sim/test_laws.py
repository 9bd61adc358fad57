"""Laws as blocks: the kernel's factors are the grammar's, by name and by value; a law's force is
its formula's.
"""

import numpy as np
import warp as wp
from numpy.linalg import norm
from pytest import approx, mark, raises
from scipy.spatial.transform import Rotation

from sim.kernels import laws
from sim.kernels.laws import BLOCKS, check_laws
from sim.kernels.structs import make_struct, types
from sim.params import LawParams
from visthrow import config
from visthrow.common.errors import ConfigError
from visthrow.diagnose.models import law_terms as grammar
from visthrow.task import Experiment

SWIRL = LawParams("payload force", (), "vertical_cross_vel", 0.02)


def knots(seed: int = 0) -> dict[str, np.ndarray]:
    """One moment of a flight in a window's quantities; two knots, for slopes."""
    rng = np.random.default_rng(seed)
    quat, cable = rng.normal(size=4), rng.normal(size=3)
    value = {
        "time": np.array([0.0, 0.1]),
        "pos_w": rng.normal(size=3),
        "vel_w": rng.normal(size=3),
        "rate_b": rng.normal(size=3),
        "quat_wb": quat / norm(quat),
        "payload_vel_w": rng.normal(size=3),
        "payload_pos_w": rng.normal(size=3),
        "cable_dir_w": cable / norm(cable),
        "tension": 0.7,
        "mount_b": rng.normal(size=3),
        "neighbour_pos_w": rng.normal(size=3),
    }
    out = {name: v if name == "time" else np.stack([v, v]) for name, v in value.items()}
    return out | {"thrust": np.array([2.5, 2.9])}


def kernels_factors():
    """The kernel's factors at that moment: scalars by name, vectors by block and name."""
    t = types("float64")
    Around = make_struct("Around", {name: getattr(t, kind) for name, kind in laws.AROUND.items()})
    k = knots()
    around = Around()
    for name in laws.AROUND:
        setattr(around, name, k[name][0] if name in k else 4.0)
    module = wp.Module("factors", None)

    def kernel(name: str, factor, kind: type) -> wp.Kernel:
        def evaluate(a: Around, out: wp.array(dtype=kind)):
            out[0] = factor(a)

        return wp.Kernel(evaluate, key=f"factor_{name}", module=module)

    def value(one: wp.Kernel, kind: type) -> np.ndarray:
        out = wp.zeros(1, dtype=kind, device="cpu")
        wp.launch(one, 1, [around], [out], device="cpu")
        return out.numpy()[0]

    # All kernels come before the first launch, which compiles the module: each that came after one
    # would compile it again.
    reals = {name: kernel(name, factor, t.real) for name, factor in laws.SCALARS.items()}
    vec3s = {
        b: {n: kernel(f"{b.replace(' ', '_')}_{n}", f, t.vec3) for n, f in of.items()}
        for b, of in laws.VECTORS.items()
    }
    return (
        {name: value(one, t.real) for name, one in reals.items()},
        {b: {n: value(one, t.vec3) for n, one in of.items()} for b, of in vec3s.items()},
        k,
    )


def test_factors_are_the_grammars():
    scalars, vectors, k = kernels_factors()
    known = grammar.KnotValues(k)
    assert set(scalars) == set(grammar.SCALARS)
    for name in scalars:
        factor = grammar.SCALARS[name]
        assert scalars[name] == approx(factor.read(known)[0], rel=1e-12), name
    assert set(vectors) == set(BLOCKS) == set(grammar.VECTORS)
    for block, of in grammar.VECTORS.items():
        assert set(vectors[block]) == set(of), block
        for name, value in vectors[block].items():
            factor = of[name]
            np.testing.assert_allclose(
                value, factor.read(known)[0], atol=1e-12, err_msg=f"{block} {name}"
            )


def expected(k: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Quantities of a moment by matrices: what kernels and arrays share is stated again."""
    pos, vel, rate, ball, ball_vel, cable, mount, other = (
        k[name][0]
        for name in (
            *("pos_w", "vel_w", "rate_b", "payload_pos_w", "payload_vel_w", "cable_dir_w"),
            *("mount_b", "neighbour_pos_w"),
        )
    )
    turn = Rotation.from_quat(k["quat_wb"][0]).as_matrix()
    up = turn[:, 2]
    level = np.eye(3) - np.outer(up, up)
    relative = ball_vel - vel
    swing = relative - cable @ relative * cable
    reach = ball - pos - turn @ mount
    mount_vel = vel + turn @ np.cross(rate, mount)
    joint = turn.T @ np.cross(reach, ball_vel - mount_vel) / (reach @ reach) - rate
    gap = pos - other
    return {
        **{f"unit_{letter}": axis for letter, axis in zip("xyz", np.eye(3))},
        **{f"axis_{letter}": axis for letter, axis in zip("xyz", turn.T)},
        "rate_w": turn @ rate,
        "rate_yaw": rate[2],
        "vel_b": turn.T @ vel,
        "along": up @ vel,
        "across": level @ vel,
        "speed_across_squared": vel @ level @ vel,
        "inverse_height": 1.0 / max(pos[2], 0.05),
        "swing": swing,
        "swing_b": turn.T @ swing,
        "cable_dir_b": turn.T @ cable,
        "under": -(up @ cable),
        "sideways": level @ cable,
        "reach_w": reach,
        "joint_rate_b": joint,
        "friction": joint / np.hypot(norm(joint), 0.1),
        "unit_z x cable_dir_b": np.cross([0.0, 0.0, 1.0], turn.T @ cable),
        "apart": gap,
        "inverse_distance": 1.0 / norm(gap),
        "neighbour": gap / norm(gap),
        "distance_upright": gap[2] / norm(gap),
    }


@mark.parametrize("seed", range(3))
def test_quantities_are_what_their_names_say(seed):
    k = knots(seed)
    known = grammar.KnotValues(k)
    by_hand = expected(k)
    named = {
        factor.quantity.strip("|")
        for of in (grammar.SCALARS, *grammar.VECTORS.values())
        for factor in of.values()
    }
    parts = {part for name in named for part in name.split(" x ")}
    assert parts - by_hand.keys() == set(k) & parts | {"slope"}
    for name, value in by_hand.items():
        np.testing.assert_allclose(known[name][0], value, atol=1e-12, err_msg=name)


def test_laws_are_part_of_the_configuration():
    path = config.find("train", "state")
    text = (
        'laws = [{block = "payload force", factors = [], vector = "vertical_cross_vel",'
        f' coefficient = 0.02}}]\nbase = "{path}"'
    )
    experiment = config.loads(Experiment, text)
    assert experiment.laws == (SWIRL,)
    assert config.loads(Experiment, config.dumps(experiment)) == experiment


@mark.parametrize(
    ("law", "message"),
    [
        ("factors = ['sped'], vector = 'vel'", "no factor 'sped'; did you mean 'speed'? Known: th"),
        ("factors = [], vector = 'joint_rate'", "no vector 'joint_rate'; Known: body_z, body_x"),
        ("factors = ['speed', 'rate', 'speed'], vector = 'vel'", "3 factors; expected at most 2"),
    ],
)
def test_a_law_that_is_none_is_refused_where_it_is_read(tmp_path, law, message):
    """The message names the file and the number of the law in it."""
    right = "{block = 'vehicle force', factors = ['speed'], vector = 'vel', coefficient = -0.01}"
    wrong = f"{{block = 'vehicle force', {law}, coefficient = 1}}"
    path = tmp_path / "mine.toml"
    path.write_text(f"base = 'train/state.toml'\nlaws = [{right}, {wrong}]")
    with raises(ConfigError) as error:
        config.load(Experiment, path)
    assert "mine.toml: laws[1]: law on vehicle force: " in str(error.value)
    assert message in str(error.value)


def test_laws_that_no_simulation_makes_are_refused():
    with raises(ValueError, match="inverse_distance vel: it takes a measured neighbour"):
        check_laws((LawParams("vehicle force", ("inverse_distance",), "vel", 1.0),))
    with raises(ValueError, match="at most"):
        check_laws((SWIRL,) * 5)
