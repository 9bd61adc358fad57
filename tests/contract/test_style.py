"""The house keeps its order: no import circle, no import upward, no long function, no crowded
folder, no mutation of a text that is gone.

An import counts wherever it stands: at the top, under TYPE_CHECKING, or in a function that is meant
to save start-up time. The rooms and their order are read from CONVENTIONS.md."""

import ast
import re
from collections.abc import Iterable, Mapping
from functools import cache
from graphlib import CycleError, TopologicalSorter
from pathlib import Path

from pytest import fixture, mark

from bench.mutations.__main__ import load
from tests.contract.test_imports import imports_of
from tests.places import ROOT

PACKAGES = ("camera", "sim", "visthrow", "hil")
LONGEST = 60
"""Lines of a function."""
MOST = 13
"""Entries of a folder that holds modules, beside :data:`ASIDE`."""
ASIDE = {"__init__.py", "__pycache__", "README.md", "py.typed"}


def modules(root: Path, packages: Iterable[str]) -> dict[str, Path]:
    """Return dotted name -> file of every module."""
    files = (path for package in packages for path in sorted((root / package).rglob("*.py")))
    return {
        ".".join(path.relative_to(root).with_suffix("").parts).removesuffix(".__init__"): path
        for path in files
    }


def graph(root: Path, packages: Iterable[str] = PACKAGES) -> dict[str, set[str]]:
    """Return module -> modules that it imports."""
    known = modules(root, packages)
    arrows = {}
    for module, path in known.items():
        names = imports_of(path, root)
        targets = {name if name in known else name.rpartition(".")[0] for name in names}
        arrows[module] = targets & set(known) - {module}
    return arrows


def circle(arrows: Mapping[str, set[str]]) -> list[str]:
    """Return modules that import each other in a circle, the first one twice; none where there is
    no circle.
    """
    try:
        TopologicalSorter(arrows).prepare()
    except CycleError as error:
        return error.args[1]
    return []


def rooms(text: str) -> list[str]:
    """Return the rooms that CONVENTIONS.md lists, from the ground up."""
    section = text.split("## Rooms", 1)[1].split("\n## ", 1)[0]
    return re.findall(r"^\d+\. `([\w.]+)`", section, re.MULTILINE)


def room_of(name: str, order: Iterable[str]) -> str:
    """Return the room of a module: the longest that its name begins with."""
    fitting = [room for room in order if name == room or name.startswith(room + ".")]
    return max(fitting, key=len)


def upward(arrows: Mapping[str, set[str]], order: list[str]) -> list[str]:
    """Return the imports from a room that stands above."""
    level = {name: order.index(room_of(name, order)) for name in arrows}
    return [
        f"{a} -> {b}"
        for a, others in sorted(arrows.items())
        for b in sorted(others)
        if level[b] > level[a]
    ]


def find_long_functions(text: str) -> list[tuple[str, int]]:
    """Return the name and the lines of each function that is too long and builds no kernel."""

    def warp(node: ast.AST) -> bool:
        return isinstance(node, ast.FunctionDef) and any(
            ast.unparse(of).startswith(("wp.func", "wp.kernel", "unique_kernel"))
            for of in node.decorator_list
        )

    functions = [
        n
        for n in ast.walk(ast.parse(text))
        if isinstance(n, ast.FunctionDef | ast.AsyncFunctionDef)
    ]
    plain = [n for n in functions if not any(warp(inner) for inner in ast.walk(n))]
    lines = [(n.name, n.end_lineno - n.lineno + 1) for n in plain]
    return [function for function in lines if function[1] > LONGEST]


def is_leftover(entry: Path) -> bool:
    """Whether a folder holds nothing but what an interpreter left there."""
    return entry.is_dir() and all(
        path.is_dir() or "__pycache__" in path.parts for path in entry.rglob("*")
    )


def find_crowded(root: Path, packages: Iterable[str] = PACKAGES) -> list[tuple[str, int]]:
    """Return each folder of modules that has too many entries."""
    folders = {path.parent for path in modules(root, packages).values()}
    counts = {
        folder: sum(
            entry.name not in ASIDE and not entry.name.startswith(".") and not is_leftover(entry)
            for entry in folder.iterdir()
        )
        for folder in folders
    }
    return sorted((str(f.relative_to(root)), count) for f, count in counts.items() if count > MOST)


ORDER = rooms((ROOT / "CONVENTIONS.md").read_text(encoding="utf-8"))


@cache
def arrows() -> dict[str, set[str]]:
    """Return the product's :func:`graph`; not when this file is imported, which every
    worker does.
    """
    return graph(ROOT)


def offences() -> set[str]:
    """Return all that is wrong in the product."""
    long = {
        f"long: {name}.{function}"
        for name, path in modules(ROOT, PACKAGES).items()
        for function, _ in find_long_functions(path.read_text(encoding="utf-8"))
    }
    return {
        *(f"circle: {name}" for name in circle(arrows())),
        *(f"upward: {arrow}" for arrow in upward(arrows(), ORDER)),
        *(f"crowded: {folder}" for folder, _ in find_crowded(ROOT)),
        *long,
    }


def test_the_house_keeps_its_order():
    assert not offences()


def test_every_part_of_the_product_is_in_a_room():
    """A new folder says where it stands; a room that is gone goes from the list."""
    parts = {".".join(name.split(".")[:2]) for name in arrows() if name.startswith("visthrow.")}
    assert {
        part
        for part in parts
        if not any(room == part or room.startswith(part + ".") for room in ORDER)
    } == set()
    assert {room for room in ORDER if room not in arrows()} == set()
    assert set(PACKAGES) <= set(ORDER)


@fixture
def house(tmp_path):
    """Write a small product of two rooms and return what writes a module of it."""

    def write(name: str, text: str = "") -> Path:
        path = tmp_path / (name.replace(".", "/") + ".py")
        path.parent.mkdir(parents=True, exist_ok=True)
        (path.parent / "__init__.py").touch()
        path.write_text(text)
        return path

    write("p.low.a")
    write("p.high.b", "from p.low import a\n")
    (tmp_path / "p" / "__init__.py").touch()
    return write


@mark.parametrize(
    "text",
    [
        "import p.high.b\n",
        "from p.high import b\n",
        "from ..high import b\n",
        "from p.high.b import name\n",
        "from typing import TYPE_CHECKING\nif TYPE_CHECKING:\n    from p.high import b\n",
        "def f():\n    from p.high.b import g\n",
    ],
)
def test_a_circle_and_an_upward_import_are_caught_wherever_they_stand(house, tmp_path, text):
    order = ["p", "p.low", "p.high"]
    assert (circle(graph(tmp_path, ["p"])), upward(graph(tmp_path, ["p"]), order)) == ([], [])
    house("p.low.a", text)
    arrows = graph(tmp_path, ["p"])
    assert set(circle(arrows)) == {"p.high.b", "p.low.a"}
    assert upward(arrows, order) == ["p.low.a -> p.high.b"]
    assert upward(arrows, ["p", "p.high", "p.low"]) == ["p.high.b -> p.low.a"]


def test_each_mutation_fits_the_code():
    """Each old text stands once in its file, or ``load`` raises; the tests that it names exist."""
    mutations = load([])
    assert mutations
    tests = {name for m in mutations for name in (*m.tests, *m.room_tests)}
    assert [name for name in sorted(tests) if not (ROOT / name).exists()] == []


def test_the_rooms_are_read_in_their_order():
    assert rooms(
        "# x\n1. `no`\n## Rooms\n\nWords.\n\n1. `a`\n2. `a.b` (c)\n\n## Next\n3. `d`\n"
    ) == ["a", "a.b"]
    assert room_of("a.bc.d", ["a", "a.b"]) == "a"
    assert room_of("a.b.d", ["a", "a.b"]) == "a.b"
    assert len(ORDER) == len(set(ORDER)) > 10


def test_a_long_function_is_caught_unless_it_builds_a_kernel():
    body = "    x = 1\n" * (LONGEST - 1)
    assert find_long_functions(f"def f():\n{body}") == []
    assert find_long_functions(f"def f():\n{body}    y = 2\n") == [("f", LONGEST + 1)]
    assert find_long_functions(
        f"class A:\n    async def f(self):\n{body.replace('    ', '        ')}        y = 2\n"
    ) == [("f", LONGEST + 1)]
    for of in ("wp.func", "wp.kernel", "wp.kernel(enable_backward=False)", "unique_kernel"):
        assert find_long_functions(f"def f():\n    @{of}\n    def g():\n        pass\n{body}") == []
    assert find_long_functions(f"def f():\n    @cache\n    def g():\n        pass\n{body}") == [
        ("f", LONGEST + 3)
    ]


def test_a_crowded_folder_is_caught(house, tmp_path):
    for i in range(MOST - 1):
        house(f"p.low.m{i}")
    (tmp_path / "p" / "low" / "README.md").touch()
    assert find_crowded(tmp_path, ["p"]) == []
    house("p.low.more")
    assert find_crowded(tmp_path, ["p"]) == [("p/low", MOST + 1)]
