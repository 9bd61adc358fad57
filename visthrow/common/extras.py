"""Packages that only some users need: imported where they are used."""

import importlib
from types import ModuleType

from visthrow.common.errors import VisthrowError


def load_extra(module: str, extra: str, what: str, error: type[VisthrowError]) -> ModuleType:
    """Import a module that needs an optional extra, for ``what``.

    Raises VisthrowError: of the type ``error``: a package is not installed; the message names it
    and the extra.
    """
    try:
        return importlib.import_module(module)
    except ModuleNotFoundError as missing:
        package = (missing.name or module).partition(".")[0]
        raise error(
            f"{what} needs the package '{package}'; install it with: pip install"
            f" 'visthrow[{extra}]'"
        ) from None
