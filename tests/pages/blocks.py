"""Code blocks of the pages, and what runs them.

A fence is run by its language: ``sh`` a line at a time, ``python`` as one program, and any language
with a ``title="NAME"`` becomes the file of that name beside the commands. ``text`` is what the
commands above it printed, which is compared. Comments in front of a fence, which readers do not
see, give options:

    <!-- run with: --throws 2 -->
        these arguments are added to each visthrow command of the block, to make it cheaper
    <!-- run train with: --iterations 1 -->  the same for one command alone
    <!-- terminals -->                       each line is a process of its own, all at once
    <!-- not run: a GPU -->
        not run, for one of :data:`REASONS`; its visthrow commands are parsed all the same

The blocks of a page run in order in a folder of the page's own that looks like the root of a clone.
What another page has run already, with the same arguments and files, is not run again: what it
wrote is copied. A training is evaluated with 4 throws for 200, a plan of the baseline begins at one
duration for five."""

import contextlib
import hashlib
import io
import os
import re
import runpy
import shlex
import shutil
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path
from unittest import mock

from tests.places import ROOT
from visthrow import cli
from visthrow.training import trainer

REASONS = {
    "a GPU",
    "a vehicle",
    "a motion-capture hall",
    "a camera",
    "firmware",
    "your flights",
    "hours",
    "minutes",
    "installs software",
    "it opens a window",
    "a cluster",
}
READABLE = ("tests", "configs", "docs")
"""Folders of the repository that a page's commands may read."""
FENCE = re.compile(
    r'((?:<!--[^\n]*-->\n+)*)^```(\w*)(?: title="([^"\n]+)")?[^\n]*\n(.*?)^```[ \t]*$',
    re.MULTILINE | re.DOTALL,
)
NUMBER, TIMED = re.compile(r"\d+(?:\.\d+)?"), re.compile(r" [\d.]+ s$")
TOLERANCE = 0.1
"""Relative tolerance of a number on a page, plus two units of its last place."""
PATIENCE = 300.0
"""For the processes of one block [s]."""


@dataclass(frozen=True)
class Block:
    """One fence.

    Attributes:
        page: file that it stands in, from the root. line: of the fence, from 1. language: of the
            fence. title: name of a file, or "".
        text: between the fences. reason: why it is not run, or "". terminals: its lines run side by
            side.
        extra: command, or "" for all -> arguments that are added.
    """

    page: str
    line: int
    language: str
    title: str
    text: str
    reason: str
    terminals: bool
    extra: dict[str, tuple[str, ...]]

    @property
    def place(self) -> str:
        """Return where it stands."""
        return f"{self.page}:{self.line}"

    def commands(self) -> list[list[str]]:
        """Return the words of each visthrow command, arguments of the comments added; another line
        is left to the shell as one word.
        """
        lines = [line.strip() for line in self.text.replace("\\\n", " ").splitlines()]
        return [self._words(line) for line in lines if line and not line.startswith("#")]

    def _words(self, line: str) -> list[str]:
        if not line.startswith("visthrow "):
            more = self.extra.get("python", ()) if line.startswith("python ") else ()
            return [f"{line.split(' #')[0]} {shlex.join(more)}" if more else line]
        words = shlex.split(line, comments=True)
        return [
            *words,
            *self.extra.get("", ()),
            *self.extra.get(words[1], ()),
            *self.extra.get(" ".join(words[1:3]), ()),
        ]


def blocks_of(page: Path, root: Path = ROOT) -> list[Block]:
    """Read the blocks of a page.

    Raises:
        ValueError: a fence without a language, one that is indented, a reason that is none of
            :data:`REASONS`, an unknown comment.
    """
    text, name = page.read_text(encoding="utf-8"), page.relative_to(root).as_posix()
    if indented := re.search(r"^[ \t>]+```", text, re.MULTILINE):
        raise ValueError(
            f"{name}: a fence that is indented is not found: {text[indented.start() :][:60]!r}"
        )
    blocks = []
    for match in FENCE.finditer(text):
        place = text.count("\n", 0, match.start(2)) + 1
        reason, terminals, extra = _parse_comments(match[1], f"{name}:{place}")
        if not match[2]:
            raise ValueError(
                f"{name}:{place}: a fence without a language: sh, python, toml, ..., or text for"
                " what was printed"
            )
        blocks.append(
            Block(name, place, match[2], match[3] or "", match[4], reason, terminals, extra)
        )
    if 2 * len(blocks) != len(re.findall(r"^```", text, re.MULTILINE)):
        raise ValueError(
            f"{name}: a fence is not closed, or stands in a way that is not understood"
        )
    return blocks


def _parse_comments(comments: str, place: str) -> tuple[str, bool, dict[str, tuple[str, ...]]]:
    reason, terminals, extra = "", False, {}
    for comment in re.findall(r"<!-- *(.*?) *-->", comments):
        if match := re.fullmatch(r"not run: (.*)", comment):
            reason = match[1]
            if reason not in REASONS:
                raise ValueError(
                    f"{place}: {reason!r} is no reason not to run a block; there are"
                    f" {sorted(REASONS)}"
                )
        elif match := re.fullmatch(r"run ?(.*?) with: (.*)", comment):
            extra[match[1]] = tuple(shlex.split(match[2]))
        elif comment == "terminals":
            terminals = True
        else:
            raise ValueError(f"{place}: unknown comment {comment!r}")
    return reason, terminals, extra


class Runner:
    """Runs pages, and remembers what it has run."""

    def __init__(self, work: Path) -> None:
        """Take an empty folder."""
        self.work = work
        self.done: dict[
            str, Path
        ] = {}  # digest of a command and its files -> copy of what it wrote
        self.printed: dict[str, str] = {}  # by the same digest
        self.last: list[str] = []  # digests of the block that ran last

    def run(self, blocks: list[Block]) -> None:
        """Run the blocks of one page in order.

        Raises:
            AssertionError: a command fails, or a file is used by no command.
            Exception: what a program raises.
        """
        folder = self.work / re.sub(r"\W", "_", blocks[0].page)
        folder.mkdir()
        for name in READABLE:
            (folder / name).symlink_to(ROOT / name)
        spoken = " ".join(block.text for block in blocks if block.language in ("sh", "python"))
        files = " ".join(block.text for block in blocks if block.title)
        names: dict[str, object] = {}
        evaluated = mock.patch.object(trainer, "EVALUATED", 4)
        starts = mock.patch("visthrow.paper.baseline.spline.LONGEST", (1.4,))
        with contextlib.chdir(folder), evaluated, starts:
            for block in blocks:
                if block.title:
                    assert block.title in spoken + files, (
                        f"{block.place}: nothing on the page uses {block.title}"
                    )
                    Path(block.title).parent.mkdir(parents=True, exist_ok=True)
                    Path(block.title).write_text(block.text, encoding="utf-8")
                elif block.reason:
                    parse(block)
                elif block.language == "python":
                    exec(compile(block.text, block.place, "exec"), names)
                elif block.language == "sh":
                    self._run_commands(block)
                else:
                    assert block.language == "text", (
                        f"{block.place}: nothing is done with {block.language!r}; give it a title"
                    )
                    printed = [self.printed.get(digest, "") for digest in self.last]
                    written = [path.read_text(encoding="utf-8") for path in Path().glob("*.toml")]
                    check_shown(block.text, "\n".join([*printed, *written]), block.place)

    def _run_commands(self, block: Block) -> None:
        self.last = []
        for jobs in (
            [block.commands()] if block.terminals else [[words] for words in block.commands()]
        ):
            jobs = [
                [part for word in words for part in _globbed(word)] if len(words) > 1 else words
                for words in jobs
            ]
            digest = _digest(jobs)
            self.last += [digest]
            if digest in self.done:
                shutil.copytree(self.done[digest], ".", dirs_exist_ok=True)
                continue
            before = _files()
            if len(jobs) > 1:
                _side_by_side(jobs, block.place)
            else:
                self.printed[digest] = _one(jobs[0], block.place)
            self.done[digest] = kept = self.work / f"kept-{len(self.done)}"
            kept.mkdir()
            for path in sorted(_files() - before):
                (kept / path[0]).parent.mkdir(parents=True, exist_ok=True)
                shutil.copy2(path[0], kept / path[0])


def check_shown(text: str, printed: str, place: str) -> None:
    """Compare each line that a page shows with what was printed: the same words, and numbers within
    :data:`TOLERANCE`. A line that ends with a time says how long the machine took.
    """
    lines = [line.strip() for line in printed.splitlines()]
    for shown in filter(None, map(str.strip, text.splitlines())):
        near = [line for line in lines if NUMBER.sub("#", line) == NUMBER.sub("#", shown)]
        assert any(TIMED.search(line) or _close(shown, line) for line in near), (
            f"{place}: the page shows {shown!r}; the command prints {near or lines[-20:]}"
        )


def _close(shown: str, printed: str) -> bool:
    pairs = zip(NUMBER.findall(shown), NUMBER.findall(printed), strict=True)
    return all(
        abs(float(one) - float(other)) <= TOLERANCE * abs(float(one)) + 2 * 10 ** -_places(one)
        for one, other in pairs
    )


def _places(number: str) -> int:
    return len(number.partition(".")[2])


def parse(block: Block) -> None:
    """Parse the visthrow commands of a block that is not run."""
    for words in block.commands() if block.language == "sh" else []:
        if words[0] == "visthrow":
            assert cli.build_parser().parse_args(words[1:]).command == words[1], block.place


def _one(words: list[str], place: str) -> str:
    """Run one command and return what a visthrow command printed."""
    output = io.StringIO()
    if words[0] == "visthrow":  # in this process: most of a command's time is what it imports
        try:
            with contextlib.redirect_stdout(output), contextlib.redirect_stderr(output):
                status = cli.main(words[1:])
        finally:
            print(output.getvalue())
    elif words[0].startswith("python "):  # as above
        status = _program(shlex.split(words[0])[1:])
    else:
        status = subprocess.run(["bash", "-ec", words[0]], env=_environment()).returncode
    assert status == 0, f"{place}: status {status}: {' '.join(words)}"
    return output.getvalue()


def _program(argv: list[str]) -> int:
    """Run what ``python`` would run: a file, or with ``-m`` a module."""
    before, module = sys.argv, argv[0] == "-m"
    sys.argv = argv[module:]
    imported = sys.modules.pop(sys.argv[0], None) if module else None  # python -m begins without it
    try:
        (runpy.run_module if module else runpy.run_path)(sys.argv[0], run_name="__main__")
    except SystemExit as end:
        return int(end.code or 0)
    finally:
        sys.argv = before
        if imported is not None:
            sys.modules[imported.__name__] = imported
    return 0


def _side_by_side(jobs: list[list[str]], place: str) -> None:
    processes = [
        subprocess.Popen([sys.executable, "-m", "visthrow.cli", *words[1:]], env=_environment())
        for words in jobs
    ]
    try:
        statuses = [process.wait(PATIENCE) for process in processes]
    finally:
        for process in processes:
            process.kill()
            process.wait()
    assert not any(statuses), f"{place}: statuses {statuses}"


def _environment() -> dict[str, str]:
    paths = {"PATH": Path(sys.executable).parent, "PYTHONPATH": ROOT}
    return os.environ | {
        key: f"{path}{os.pathsep}{os.environ.get(key, '')}" for key, path in paths.items()
    }


def _globbed(word: str) -> list[str]:
    paths = (
        []
        if Path(word).is_absolute() or not set("*[?") & set(word)
        else sorted(map(str, Path().glob(word)))
    )
    return paths or [word]


def _files() -> set[tuple[str, int]]:
    return {
        (str(path), path.stat().st_mtime_ns)
        for path in Path().rglob("*")
        if path.is_file() and path.parts[0] not in READABLE
    }


def _digest(jobs: list[list[str]]) -> str:
    """Return a digest of commands, and of the page's files that they name or that those may name in
    turn.
    """
    spoken, named = repr(jobs), []
    files = [
        path
        for path in sorted(Path().rglob("*.*"))
        if path.is_file() and path.parts[0] not in READABLE
    ]
    while more := [path for path in files if path not in named and str(path) in spoken]:
        named += more
        spoken += "".join(
            path.read_text(encoding="utf-8", errors="ignore")
            for path in more
            if path.suffix in {".toml", ".yaml", ".py"}
        )
    return hashlib.sha256(
        spoken.encode() + b"".join(path.read_bytes() for path in named)
    ).hexdigest()


def pages() -> list[Path]:
    """Return README.md and all pages of the site."""
    return [ROOT / "README.md", *sorted((ROOT / "docs").rglob("*.md"))]
