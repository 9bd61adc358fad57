"""The schema of each folder of configs, and of each file that differs from its folder."""

from pkgutil import resolve_name

from visthrow.common.errors import ConfigError, suggest
from visthrow.common.toml_text import tables_beside

SCHEMAS: dict[str, str] = tables_beside(__file__, "kinds.toml")
"""``kind`` or ``kind/name`` -> ``module:class``; the longer key wins."""

KINDS = [key for key in SCHEMAS if "/" not in key]
"""Folders of configs."""


def schema_of(kind: str, name: str = "") -> type:
    """Return the schema of a config and import its module only then.

    Raises ConfigError: the kind is unknown.
    """
    target = SCHEMAS.get(f"{kind}/{name}") or SCHEMAS.get(kind)
    if target is None:
        raise ConfigError(f"no kind of config '{kind}'; {suggest(kind, KINDS)}")
    return resolve_name(target)


def kinds_of(schema: type) -> list[str]:
    """Return the folders of configs whose files have a schema; none if no shipped config has it."""
    target = f"{schema.__module__}:{schema.__name__}"
    return [key for key in KINDS if SCHEMAS[key] == target]
