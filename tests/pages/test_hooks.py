"""The reference prints itself: every key of the shipped configurations, every command."""

from dataclasses import fields
from types import SimpleNamespace

from pytest import mark

from docs import hooks
from tests.pages.blocks import ROOT, pages
from visthrow import __version__, cli, config
from visthrow.config import kinds
from visthrow.logs.check.thrust_checks import INPUTS
from visthrow.logs.mapping import ChannelMap, Split, TimeColumn

SHOWN = [
    shown for page in pages() for shown in hooks.KEYS.findall(page.read_text(encoding="utf-8"))
]


@mark.parametrize(("kind", "name", "only"), SHOWN)
def test_every_key_has_a_row(kind, name, only):
    path = config.find(kind, name)
    values = config.to_dict(config.load(kinds.schema_of(kind, path.stem), path))
    text = hooks.keys_of(kind, name, only)
    keys = values[only] if only else values
    assert keys
    assert all(f"| `{key}` |" in text for key in keys)


def test_the_page_shows_what_a_mapping_may_say_without_being_built():
    page = (ROOT / "docs/reference/models.md").read_text("utf-8")
    keys = [f.name for cls in (TimeColumn, ChannelMap, Split) for f in fields(cls)]
    assert not [name for name in (*keys, *INPUTS, "acc_b", "pos_w") if f"`{name}`" not in page]


def test_a_row_has_unit_value_and_source():
    row = "| `length` | m | above 0 and at most 1000 | `0.33` | of the rope, without the payload |"
    assert f"{row} Sec. III-A |" in hooks.keys_of("rope", "paper")
    assert "### `[action]`" in hooks.keys_of("task", "state")
    assert "| above 0 |" in hooks.keys_of("task", "state")


def test_every_command_is_shown():
    text = hooks.on_page_markdown((ROOT / "docs/reference/commands.md").read_text("utf-8"))
    assert all(f"usage: visthrow {command}" in text for command in cli.COMMANDS)
    assert "## hil check" in text


def test_every_page_names_version_and_licence():
    site = hooks.on_config(SimpleNamespace(copyright=None))
    assert site.copyright == f"visthrow {__version__}, MIT licence"
