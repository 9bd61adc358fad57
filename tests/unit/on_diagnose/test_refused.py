"""Real logs with a channel empty, in another unit or with exchanged axes: an error that says so
before anything is named.
"""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from visthrow.common.errors import LogError
from visthrow.diagnose.inputs import setup as setups
from visthrow.logs.readers import table

DATA = Path(__file__).resolve().parents[2] / "data"
SWING = ("pendulum_encoder", "real/pendulum_single/single_pendulum_id.csv.gz")
CABLE = ("cf_payload", "real/payload_cf_single/log206.csv.gz")
CAMERA = ("slungload_camera", "slungload_camera/rosbag_16.csv.gz")


def model(setup: str, path: str, change: Callable[[table.Table], dict]):
    """Of a table with some columns changed."""
    chosen, columns = setups.load(setup), table.read_table(DATA / path)
    return setups.model_of(chosen, table.logs_of(columns | change(columns), chosen.table, path))


def nothing(*names: str) -> Callable[[table.Table], dict]:
    """Columns without a number."""
    return lambda t: {name: np.full(len(t[name]), np.nan) for name in names}


def times(factor: float, *names: str) -> Callable[[table.Table], dict]:
    """Columns in another unit."""
    return lambda t: {name: factor * t[name] for name in names}


@pytest.mark.parametrize(
    ("data", "change", "words"),
    [
        (SWING, nothing("theta_rad"), "no stretch of these logs"),
        (SWING, times(180.0 / np.pi, "theta_rad"), "degrees, or another zero"),
        (
            CABLE,
            nothing(*(f"stateEstimateZ.p{axis}" for axis in "xyz")),
            "missing everywhere: payload_pos_w",
        ),
        (CABLE, times(1e3, "ctrlLee.thrustSI"), "times the weight"),
        (CAMERA, nothing("l_px", "l_py", "l_pz"), "no stretch of these logs"),
        (
            CAMERA,
            lambda t: {"d_px": t["d_py"], "d_py": t["d_px"]},
            "other axes, another unit, or another marker",
        ),
    ],
)
def test_spoiled_channels_are_refused(data, change, words):
    assert model(*data, lambda _: {}).stretches  # as it is, it can be looked at
    with pytest.raises(LogError, match=words):
        model(*data, change)


def test_a_channel_of_few_samples_has_a_noise_all_the_same():
    first = np.arange(4000)  # of 250 a second; the payload is seen a few times in it

    def few(t: table.Table) -> dict:
        held = {
            name: np.where(first_rows(t) % 90 == 0, t[name], np.nan)
            for name in t
            if name.startswith("stateEstimateZ.p")
        }
        return {name: values for name, values in held.items() if name[-2:] in ("px", "py", "pz")}

    def first_rows(t: table.Table) -> np.ndarray:
        return np.resize(first, len(t["t_s"]))

    found = model(*CABLE, few)
    assert all(np.all(np.isfinite(s.sigma)) for s in found.stretches)
    assert all(np.all(np.isfinite(r)) for r in found.residuals({}))


def test_a_spring_at_the_joint_is_told_from_nothing_else_but_the_scale():
    swing = model(*SWING, lambda _: {})
    window = swing.windows(
        {"pendulum_length": -0.0168, "coulomb_friction": 0.21, "quadratic_drag": 0.0038}
    )[0]
    names = [effect.name for effect in swing.effects]
    spring, scale = (
        window.effects[:, names.index("joint_stiffness")],
        window.effects[:, names.index("encoder_scale")],
    )
    basis = np.column_stack((window.nuisance, window.effects[:, names.index("pendulum_length")]))
    left = [x - basis @ np.linalg.lstsq(basis, x, rcond=None)[0] for x in (spring, scale)]
    assert abs(np.dot(*left)) > 0.9 * np.linalg.norm(left[0]) * np.linalg.norm(left[1])
