"""Calibration files of other tools, as they write them."""

import tomllib

from camera.params import FisheyeParams
from tests.places import DATA

FILES = tomllib.loads((DATA / "lenses.toml").read_text())
LENSES = FILES["lens"]


def kalibr_text(lens: FisheyeParams) -> str:
    """Return a Kalibr camchain of one camera."""
    return f"""cam0:
  camera_model: pinhole
  intrinsics: [{lens.fx}, {lens.fy}, {lens.cx}, {lens.cy}]
  distortion_model: equidistant
  distortion_coeffs: {list(lens.coefficients)}
  resolution: [{lens.width}, {lens.height}]
"""
