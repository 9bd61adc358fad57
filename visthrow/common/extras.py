"""Import optional packages where they are used."""

import importlib
from types import ModuleType

from visthrow.common.errors import VisthrowError

PACKAGES = {
    "cv2": "opencv-python-headless",
    "mujoco": "mujoco-core",
    "rsl_rl": "rsl-rl-lib",
    "serial": "pyserial",
    "skimage": "scikit-image",
    "warp": "warp-lang",
}
"""Import name -> name of the package, if these differ."""


def missing_package(error: ModuleNotFoundError) -> str:
    """Return the installation name of the package that could not be imported."""
    module = (error.name or "").partition(".")[0]
    return PACKAGES.get(module, module)


def load_extra(module: str, extra: str, what: str, error: type[VisthrowError]) -> ModuleType:
    """Import a module that needs an optional extra.

    Raises ``error``: a package is not installed; the message names ``what`` needs it, the package
    and the extra.
    """
    try:
        return importlib.import_module(module)
    except ModuleNotFoundError as missing:
        raise error(
            f"{what} needs the package '{missing_package(missing)}'; install it with: pip install"
            f" 'visthrow[{extra}]'"
        ) from None
