"""Every shipped config fills its schema, and every number says where it comes from."""

import re
import tomllib
from pathlib import Path

import pytest

from visthrow import config
from visthrow.config import kinds

FILES = sorted(config.configs_root().rglob("*.toml"))
COMMENTED = ("vehicle", "rope", "camera", "release", "sim", "start", "task")
"""Kinds whose every number carries a comment: its table or equation of the paper, or why it was chosen."""

HAS_NUMBER = re.compile(r"(?<![\w.])[-+]?\d")


def named(path: Path) -> str:
    return str(path.relative_to(config.configs_root()))


@pytest.mark.parametrize("path", FILES, ids=named)
def test_fills_its_schema(path):
    schema = kinds.schema_of_file(path)
    loaded = config.load(schema, path)
    assert config.loads(schema, config.dumps(loaded)) == loaded


def uncommented(text: str) -> list[str]:
    """Return the lines with a number and no comment beside them, or above them since the last table or empty line."""
    wrong, explained = [], False
    for line in text.splitlines():
        bare = line.strip()
        if not bare or bare.startswith("["):
            explained = "#" in bare
        elif bare.startswith("#"):
            explained = True
        elif (
            "=" in bare and HAS_NUMBER.search(bare.split("=", 1)[1].split("#")[0]) and "#" not in bare and not explained
        ):
            wrong.append(bare)
    return wrong


@pytest.mark.parametrize("path", [path for path in FILES if path.parent.name in COMMENTED], ids=named)
def test_every_number_says_where_it_comes_from(path):
    assert not uncommented(path.read_text(encoding="utf-8"))


def test_the_check_itself():
    assert uncommented("a = 1\nb = 2  # because\n") == ["a = 1"]
    assert uncommented("# because\na = 1\nb = [2, 3]\n") == []
    assert uncommented("# because\na = 1\n\nb = 2\n[t]\nc = 3") == ["b = 2", "c = 3"]
    assert uncommented('a = "x1"\nb = true') == []


def test_every_schema_has_a_config_and_every_folder_a_schema():
    folders = {path.parent.name for path in FILES}
    assert {key for key in kinds.SCHEMAS if "/" not in key} == folders
    for key in kinds.SCHEMAS:
        if "/" in key:
            assert (config.configs_root() / f"{key}.toml").exists()


def test_a_changed_digit_in_a_key_is_caught():
    """The loader really reads these files: spoil one key of one of them."""
    path = config.find("vehicle", "paper")
    text = path.read_text(encoding="utf-8").replace("collision_radius", "collision_radios")
    assert "collision_radios" in tomllib.loads(text)
    with pytest.raises(config.ConfigError, match="collision_radios: unknown key; did you mean 'collision_radius'"):
        config.loads(kinds.schema_of("vehicle"), text)
