"""Every shipped config fills its schema, and every number says where it comes from."""

import re
import types
import typing
from pathlib import Path

from pytest import mark, raises

from camera.params import CameraParams
from sim.params import PlantParams, SensingParams
from visthrow import config
from visthrow.config import effects, kinds, schema

FILES = sorted(config.configs_root().rglob("*.toml"))
COMMENTED = ("vehicle", "rope", "camera", "release", "sim", "start", "task", "effects")
"""Kinds whose every number carries a comment: its table or equation of the paper, or why it was
chosen.
"""
TEXT = re.compile(r'^\w+ = (?:".*"|\[(?:"[^"]*"(?:, )?)*\])$|^prior_sd = [-\d.e]+$', re.MULTILINE)
"""Lines of words in a table of effects, and its prior, which its ``source`` explains."""

HAS_NUMBER = re.compile(r"(?<![\w.])[-+]?\d")


def load_named(path: Path) -> str:
    return str(path.relative_to(config.configs_root()))


@mark.parametrize("path", FILES, ids=load_named)
def test_fills_its_schema(path):
    schema = kinds.schema_of(path.parent.name, path.stem)
    loaded = config.load(schema, path)
    assert config.loads(schema, config.dumps(loaded)) == loaded


def find_uncommented(text: str) -> list[str]:
    """Return the lines with a number and no comment beside them, or above them since the last table
    or empty line.
    """
    wrong, explained = [], False
    for line in text.splitlines():
        bare = line.strip()
        if not bare or bare.startswith("["):
            explained = "#" in bare
        elif bare.startswith("#"):
            explained = True
        elif (
            "=" in bare
            and HAS_NUMBER.search(bare.split("=", 1)[1].split("#")[0])
            and "#" not in bare
            and not explained
        ):
            wrong.append(bare)
    return wrong


@mark.parametrize("path", [path for path in FILES if path.parent.name in COMMENTED], ids=load_named)
def test_every_number_says_where_it_comes_from(path):
    text = path.read_text(encoding="utf-8")
    assert not find_uncommented(TEXT.sub("", text) if path.parent.name == "effects" else text)


def test_the_check_itself():
    assert find_uncommented(
        TEXT.sub("", 'source = "of 2012"\nprior_sd = 1e-3\nof = ["x_1", "y"]\nfloor = 2.0')
    ) == ["floor = 2.0"]
    assert find_uncommented("a = 1\nb = 2  # because\n") == ["a = 1"]
    assert find_uncommented("# because\na = 1\nb = [2, 3]\n") == []
    assert find_uncommented("# because\na = 1\n\nb = 2\n[t]\nc = 3") == ["b = 2", "c = 3"]
    assert find_uncommented('a = "x1"\nb = true') == []


def test_the_catalogue_reads_every_file_of_effects_and_every_number_of_a_change_exists():
    assert set(effects.FILES) == set(config.available("effects"))
    kinds_of = {
        "plant": PlantParams,
        "sensing": SensingParams,
        "camera": CameraParams,
        "step_square": float,
    }
    for name, effect in effects.catalogue().items():
        for path in [*(c.path for c in effect.changes), *(x.path for x in effect.lowest)]:
            kind = types.SimpleNamespace(**kinds_of)
            for part in path.split("."):
                kind = (
                    getattr(kind, part)
                    if isinstance(kind, types.SimpleNamespace)
                    else schema.hints(kind)[part]
                )
            index = max((c.index or 0 for c in effect.changes if c.path == path), default=0)
            numbers = typing.get_args(kind) or (kind,)
            assert numbers[index] is float, f"{name}: {path}[{index}] is {kind}"


def test_an_effect_that_changes_nothing_or_names_no_condition_is_refused():
    text = config.find("effects", "numerics").read_text(encoding="utf-8")
    with raises(config.ConfigError, match="neither; expected one"):
        config.loads(kinds.schema_of("effects"), re.sub(r"(?m)^changes = .*$", "", text))
    with raises(
        config.ConfigError, match="needs: got 'never'; expected one of: always, aerodynamics"
    ):
        config.loads(kinds.schema_of("effects"), text + 'needs = "never"\n')


@mark.parametrize("key", ["changes", "lowest"])
def test_an_effect_on_a_number_that_does_not_exist_is_refused(key):
    text = config.find("effects", "rope").read_text(encoding="utf-8")
    path = "plant.rope.payload_drag"
    wrong = text.replace(f'{key} = [{{ path = "{path}"', f'{key} = [{{ path = "{path}s"')
    with raises(
        config.ConfigError, match=f"path '{path}s': no 'payload_drags'; expected one of: s"
    ):
        config.loads(kinds.schema_of("effects"), wrong)


def test_every_schema_has_a_config_and_every_folder_a_schema():
    folders = {path.parent.name for path in FILES}
    assert {key for key in kinds.SCHEMAS if "/" not in key} == folders
    for key in kinds.SCHEMAS:
        if "/" in key:
            assert (config.configs_root() / f"{key}.toml").exists()
