"""Render templates."""

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any


def render(
    path: Path,
    filters: Mapping[str, Callable[..., Any]],
    *,
    escape: bool = False,
    **values: Any,
) -> str:
    """Return the text of a Jinja template with values inserted; a missing name is an error.

    Args:
        path: file of the template.
        filters: filter functions for the template, by name.
        escape: whether to escape values for HTML.
        **values: values of the template's names.
    """
    import jinja2

    environment = jinja2.Environment(
        loader=jinja2.FileSystemLoader(path.parent),
        undefined=jinja2.StrictUndefined,
        autoescape=escape,
        trim_blocks=True,
        lstrip_blocks=True,
        keep_trailing_newline=True,
    )
    environment.filters.update(filters)
    return environment.get_template(path.name).render(values)
