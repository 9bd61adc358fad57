"""Strict configuration: accepted files, refused files, and the messages."""

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from pytest import fixture, mark, raises

from visthrow import config
from visthrow.common import toml_text
from visthrow.common.errors import ConfigError


@dataclass(frozen=True)
class Inner:
    kind: Literal["a", "b"]
    gain: tuple[float, float]
    table: dict[str, float] | None = None

    def __post_init__(self) -> None:
        if self.gain[0] < 0.0:
            raise ValueError(f"gain[0] is {self.gain[0]}; expected 0 or more")


@dataclass(frozen=True)
class Outer:
    name: str
    count: int
    mass: float
    inner: Inner
    flag: bool = False
    layers: tuple[int, ...] = (256, 128)
    limit: float | None = None
    stages: tuple[Inner, ...] = ()
    spare: Inner | None = None


GOOD = """
name = "x"
count = 3
mass = 2
[inner]
kind = "a"
gain = [1, 2.5]
"""


@fixture
def write(tmp_path: Path):
    def _write(name: str, text: str) -> Path:
        path = tmp_path / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text)
        return path

    return _write


def test_values_arrive_with_their_types(write):
    loaded = config.load(Outer, write("a.toml", GOOD))
    assert loaded == Outer("x", 3, 2.0, Inner("a", (1.0, 2.5)))
    assert type(loaded.mass) is float
    assert type(loaded.inner.gain[0]) is float


@mark.parametrize(
    ("change", "parts"),
    [
        (("count = 3", "count = 3.0"), ["count", "3.0 (float)", "a whole number"]),
        (("count = 3", "count = true"), ["count", "True (bool)", "a whole number"]),
        (("mass = 2", "mass = true"), ["mass", "True (bool)", "a number"]),
        (("mass = 2", 'mass = "2"'), ["mass", "'2' (str)", "a number"]),
        (("mass = 2", "mass = nan"), ["mass", "nan", "a finite number"]),
        (("mass = 2", "mass = -inf"), ["mass", "-inf", "a finite number"]),
        (("mass = 2", "mass = 1979-05-27"), ["mass", "date", "a number"]),
        (("mass = 2", f"mass = 1{'0' * 400}"), ["mass", "a finite number"]),
        (("mass = 2\n", ""), ["missing mass", "a number", "given: name, count, inner"]),
        (
            ("mass = 2", "mas = 2"),
            ["mas", "unknown key", "did you mean 'mass'?", "count, flag, inner"],
        ),
        (('kind = "a"', 'kind = "c"'), ["inner.kind", "'c'", "one of 'a', 'b'"]),
        (("[1, 2.5]", "[1]"), ["inner.gain", "a list of 1", "a list of 2"]),
        (("[1, 2.5]", "[1, true]"), ["inner.gain[1]", "True (bool)"]),
        (("[1, 2.5]", "1"), ["inner.gain", "1 (int)", "a list of 2"]),
        (("[1, 2.5]", "[-1, 0]"), ["inner", "gain[0] is -1.0; expected 0 or more"]),
        (("[1, 2.5]", "[1, 2]\n[mass2]"), ["mass2", "unknown key"]),
        (("count = 3", "count = {a = 1}"), ["count", "a table with the keys a", "a whole number"]),
        (("count = 3", "count ="), ["not valid TOML"]),
    ],
)
def test_mistakes_are_refused_with_file_key_and_what_exists(write, change, parts):
    path = write("a.toml", GOOD.replace(*change))
    with raises(ConfigError) as caught:
        config.load(Outer, path)
    for part in ["a.toml", *parts]:
        assert part in str(caught.value)


def test_an_unknown_key_is_known_beside_overrides_too(write):
    path = write("a.toml", GOOD.replace("gain", "gane"))
    with raises(ConfigError, match=r"inner.gane: unknown key.*with count=4"):
        config.load(Outer, path, ["count=4"])


def test_missing_file_names_its_neighbours(write):
    path = write("paper.toml", GOOD)
    with raises(ConfigError, match=r"papr.toml: no such file; did you mean 'paper.toml'"):
        config.load(Outer, path.parent / "papr.toml")


def test_a_misspelt_ending_names_the_file_of_this_folder(write, monkeypatch):
    monkeypatch.chdir(write("mine.toml", GOOD).parent)
    with raises(ConfigError, match=r"no TOML file of that name\); did you mean 'mine.toml'"):
        config.find("train", "mine.tml")


@dataclass(frozen=True)
class Listed:
    inner: tuple[Inner, ...]


@mark.parametrize("text", ['inner = "a.toml"', 'inner = ["a.toml"]'])
def test_a_list_of_tables_is_in_no_file(write, text):
    with raises(ConfigError, match="a table with the keys kind, gain") as caught:
        config.load(Listed, write("b.toml", text))
    assert "path of a file" not in str(caught.value)
    with raises(ConfigError, match="has no keys, so '0' cannot be set") as caught:
        config.load(Listed, write("b.toml", "inner = []"), ["inner.0.gain=1"])
    assert "path of a file" not in str(caught.value)


def test_an_include_falls_back_to_the_configs_folder(write, monkeypatch, tmp_path):
    write("root/inner/x.toml", 'kind = "b"\ngain = [3, 4]')
    monkeypatch.setattr(config, "configs_root", lambda: tmp_path / "root")
    path = write("a.toml", 'name = "x"\ncount = 1\nmass = 1\ninner = "inner/x.toml"')
    assert config.load(Outer, path).inner.kind == "b"
    with raises(ConfigError, match=r"no file 'inner/y.toml'.*did you mean 'inner/x.toml'"):
        config.load(Outer, write("b.toml", path.read_text().replace("x.toml", "y.toml")))


def test_a_base_s_include_is_resolved_beside_the_base_before_merging(write):
    write("shared/inner.toml", 'kind = "b"\ngain = [3, 4]')
    write("shared/base.toml", 'name = "x"\ncount = 1\nmass = 1\ninner = "inner.toml"')
    path = write("a.toml", 'base = "shared/base.toml"\n[inner]\ngain = [5, 6]')
    assert config.load(Outer, path).inner == Inner("b", (5.0, 6.0))


@dataclass(frozen=True)
class Row:
    name: str
    a: int
    b: tuple[int, int]
    c: int = 0


@dataclass(frozen=True)
class Rows:
    rows: dict[str, Row]


def test_a_table_among_like_ones_lies_on_top_of_its_base():
    text = "[rows.z]\nbase = 'y'\nc = 5\n[rows.x]\na = 1\nb = [2, 3]\n[rows.y]\nbase = 'x'\na = 4\n"
    loaded = config.loads(Rows, text)
    assert loaded.rows == {
        "z": Row("z", 4, (2, 3), 5),
        "x": Row("x", 1, (2, 3)),
        "y": Row("y", 4, (2, 3)),
    }
    assert list(loaded.rows) == ["z", "x", "y"], "in the order of the file"
    assert config.loads(Rows, config.dumps(loaded)) == loaded
    assert config.loads(Rows, text, ["rows.x.a=7"]).rows["x"].a == 7


@mark.parametrize(
    ("text", "message"),
    [
        (
            "[rows.x]\na = 1\nb = [1, 2]\n[rows.y]\nbase = 'z'",
            "rows.y.base: got 'z'; expected another table; known: x",
        ),
        ("[rows.x]\nbase = 'y'\n[rows.y]\nbase = 'x'", "rows.y.base: got 'x'"),
        ("[rows.x]\nbase = 'x'", "rows.x.base: got 'x'"),
        ("[rows.x]\nbase = { a = 1 }", "rows.x.base: got a table"),
        ("[rows.x]\na = 1\nb = [1, 2]\n[rows.y]\nbase = 'x'\nd = 1", "rows.y.d: unknown key"),
        ("[rows.x]\na = 1\n[rows.y]\nbase = 'x'", "missing b"),
        (
            "[rows.x]\nname = 'y'\na = 1\nb = [1, 2]",
            "rows.x.name: got 'y'; expected the heading, 'x'",
        ),
    ],
)
def test_a_wrong_base_of_a_table_is_refused(text, message):
    with raises(ConfigError) as caught:
        config.loads(Rows, text)
    assert message in str(caught.value)


def test_circles_are_refused(write):
    write("a.toml", 'base = "b.toml"')
    path = write("b.toml", 'base = "a.toml"')
    with raises(ConfigError, match=r"cycle: .*b\.toml -> .*a\.toml -> .*b\.toml"):
        config.load(Outer, path)


def test_overrides_apply_in_order_after_includes(write):
    write("inner.toml", 'kind = "b"\ngain = [3, 4]')
    path = write("a.toml", GOOD)
    overrides = [
        "inner=" + str(path.parent / "inner.toml"),
        "inner.gain=[7, 8]",
        "name=plain words",
        "layers=[]",
        "limit=2",
        "count=4",
        "count=5",
        'spare={kind="a", gain=[0, 0]}',
        "inner.table={k=1}",
        "inner.table.m=2",
    ]
    loaded = config.load(Outer, path, overrides)
    assert loaded.inner == Inner("b", (7.0, 8.0), {"k": 1.0, "m": 2.0})
    assert (loaded.name, loaded.layers, loaded.limit, loaded.count) == ("plain words", (), 2.0, 5)
    assert loaded.spare == Inner("a", (0.0, 0.0))


@mark.parametrize(
    ("override", "message"),
    [
        ("inner.gian=[1,2]", "did you mean 'gain'"),
        ("innr.gain=[1,2]", "did you mean 'inner'"),
        ("mass.x=1", "has no keys"),
        ("mass", "expected key.path=value"),
        ("=1", "expected key.path=value"),
        ("mass=heavy", "got 'heavy'"),
        ("count=1.5", "a whole number"),
        ("inner=nowhere.toml", "no file 'nowhere.toml'"),
    ],
)
def test_bad_overrides_name_themselves_and_what_exists(write, override, message):
    with raises(ConfigError) as caught:
        config.load(Outer, write("a.toml", GOOD), [override])
    assert f"override '{override}'" in str(caught.value)
    assert message in str(caught.value)


def test_dumps_loads_back_equal(write):
    inner = Inner("b", (1e-12, 1e300), {"a key with spaces": 1.0, "ü": -0.0})
    text = 'quotes " backslash \\ newline \n tab \t del \x7f end'
    full = Outer(text, -1, 0.1, inner, True, (), None, (inner, Inner("a", (0.0, 0.0))), None)
    assert config.loads(Outer, config.dumps(full)) == full


def test_none_word_overrules_a_default(write):
    @dataclass(frozen=True)
    class Limited:
        limit: float | None = 3.0

    assert config.loads(Limited, "").limit == 3.0
    assert config.loads(Limited, config.dumps(Limited(None))).limit is None


def test_toml_writer_refuses_what_toml_lacks():
    for value in (None, object()):
        with raises(ValueError, match="TOML item"):
            toml_text.dumps({"a": {"b": value}})


def test_find_by_name_by_path_and_what_exists():
    assert config.find("vehicle", "paper") == config.configs_root() / "vehicle" / "paper.toml"
    assert config.find("vehicle", "vehicle/paper.toml").samefile(config.find("vehicle", "paper"))
    assert config.find("rope", config.find("vehicle", "paper")) == config.find("vehicle", "paper")
    with raises(ConfigError, match=r"no vehicle config 'papre'.*did you mean 'paper'"):
        config.find("vehicle", "papre")
    with raises(ConfigError, match=r"no kind of config 'vehicel'; did you mean 'vehicle'"):
        config.find("vehicel", "paper")
