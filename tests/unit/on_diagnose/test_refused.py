"""Real logs with a channel empty, in another unit or with exchanged axes: an error that says so
before anything is named.
"""

from collections.abc import Callable

import numpy as np
from pytest import mark, raises

from tests.places import DATA
from visthrow.common.errors import LogError
from visthrow.diagnose.inputs import setup as setups
from visthrow.logs.readers import table

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


@mark.parametrize(
    ("data", "change", "words"),
    [
        (SWING, nothing("theta_rad"), "missing everywhere: angle"),
        (SWING, times(180.0 / np.pi, "theta_rad"), "degrees, or another zero"),
        (
            CABLE,
            nothing(*(f"stateEstimateZ.p{axis}" for axis in "xyz")),
            "missing everywhere: payload_pos_w",
        ),
        (CABLE, times(1e3, "ctrlLee.thrustSI"), "times the weight"),
        (CAMERA, nothing("l_px", "l_py", "l_pz"), "missing everywhere: payload_pos_w"),
        (
            CAMERA,
            lambda t: {"d_px": t["d_py"], "d_py": t["d_px"]},
            "other axes, another unit, or another marker",
        ),
    ],
)
def test_spoiled_channels_are_refused(data, change, words):
    assert model(*data, lambda _: {}).stretches  # as it is, it can be looked at
    with raises(LogError, match=words):
        model(*data, change)
