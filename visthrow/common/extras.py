"""Packages that only some users need: imported where they are used."""

import importlib
from types import ModuleType

from visthrow.common.errors import VisthrowError


def load_extra(module: str, extra: str, what: str, error: type[VisthrowError]) -> ModuleType:
    """Import a package of an optional extra, which ``what`` needs.

    Raises VisthrowError: of the type ``error``: it is not installed; the message names the extra.
    """
    try:
        return importlib.import_module(module)
    except ModuleNotFoundError:
        package = module.partition(".")[0]
        raise error(
            f"{what} needs the package '{package}'; install it with: pip install"
            f" 'visthrow[{extra}]'"
        ) from None
