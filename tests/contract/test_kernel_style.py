"""Every Warp kernel of the simulator states what its arguments are, in one order, under one set of
headings.
"""

import ast
import io
import tokenize

import pytest

from tests.places import ROOT

GROUPS = ("Params:", "State in:", "In:", "State out:", "Out:")
"""Headings of the argument groups; some may be missing, the order may not differ."""


def is_kernel(node: ast.AST) -> bool:
    """Tell whether a function is decorated as ``wp.kernel``, with or without arguments, or as
    ``unique_kernel``.
    """
    if not isinstance(node, ast.FunctionDef):
        return False
    marks = (mark.func if isinstance(mark, ast.Call) else mark for mark in node.decorator_list)
    return any(ast.unparse(mark) in ("wp.kernel", "unique_kernel") for mark in marks)


def kernels(text: str) -> list[ast.FunctionDef]:
    return [node for node in ast.walk(ast.parse(text)) if is_kernel(node)]


def problems(text: str, kernel: ast.FunctionDef) -> list[str]:
    """Return what is wrong with the headings of one kernel's arguments."""
    comments = {
        token.start[0]: token.string.lstrip("# ").strip()
        for token in tokenize.generate_tokens(io.StringIO(text).readline)
        if token.type == tokenize.COMMENT and token.line.strip().startswith("#")
    }
    arguments = kernel.args.posonlyargs + kernel.args.args
    if not arguments:
        return []
    first, last = kernel.lineno, kernel.body[0].lineno
    headings = [
        (line, word)
        for line, word in sorted(comments.items())
        if first < line < last and word in GROUPS
    ]
    present = [word for _, word in headings]
    wrong = []
    if present != sorted(set(present), key=GROUPS.index):
        wrong.append(f"headings stand as {present}; expected an ordered choice of {list(GROUPS)}")
    if not headings or headings[0][0] > arguments[0].lineno:
        wrong.append(f"argument '{arguments[0].arg}' stands under no heading")
    for (line, word), (following, _) in zip(headings, [*headings[1:], (last, "")]):
        if not any(line < argument.lineno < following for argument in arguments):
            wrong.append(f"no argument stands under '{word}'")
    return wrong


@pytest.mark.parametrize(
    "path", sorted((ROOT / "sim").rglob("*.py")), ids=lambda path: str(path.relative_to(ROOT))
)
def test_arguments_of_kernels_are_grouped(path):
    text = path.read_text(encoding="utf-8")
    wrong = [
        f"{path.name}: {kernel.name}: {problem}"
        for kernel in kernels(text)
        for problem in problems(text, kernel)
    ]
    assert not wrong


@pytest.mark.parametrize(
    ("arguments", "count"),
    [
        ("# Params:\n p: int,\n # In:\n a: int,\n # Out:\n b: int,", 0),
        ("# In:\n a: int,\n # Params:\n p: int,", 1),
        ("# In:\n a: int,\n # In:\n p: int,", 1),
        ("a: int,\n # Out:\n b: int,", 1),
        ("a: int,", 1),
        ("# Params:\n # In:\n a: int,", 1),
    ],
)
@pytest.mark.parametrize("mark", ["wp.kernel", "wp.kernel(module='unique')", "unique_kernel"])
def test_the_check_itself(arguments, count, mark):
    text = f"@{mark}\ndef k(\n {arguments}\n):\n    pass\n"
    (kernel,) = kernels(text)
    assert len(problems(text, kernel)) == count


def settings(text: str) -> set[str]:
    """Return the settings of Warp that a text assigns."""
    targets = [
        target
        for node in ast.walk(ast.parse(text))
        if isinstance(node, ast.Assign)
        for target in node.targets
    ]
    return {
        ast.unparse(target)
        for target in targets
        if ast.unparse(target).startswith(("wp.config.", "warp.config."))
    }


def test_kernels_are_compiled_alike_in_all_processes():
    """How they are is part of their hash: pictures were compiled a second time where no simulator
    had been imported before.
    """
    files = [
        path
        for package in ("camera", "sim", "visthrow", "hil")
        for path in (ROOT / package).rglob("*.py")
    ]
    setters = {
        path.relative_to(ROOT).as_posix()
        for path in files
        if settings(path.read_text(encoding="utf-8"))
    }
    assert setters == {"camera/warp_start.py"}
