"""Text from templates."""

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
    """Return the text of a Jinja template with its values; a name that is missing is an error.

    Args:
        path: of the template.
        filters: functions of the template, by name.
        escape: whether values are put into HTML.
        **values: names of the template and what they stand for.
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
