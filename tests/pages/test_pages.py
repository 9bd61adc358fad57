"""README and site: every block runs or says why not, links lead somewhere, sentences are short."""

import re

from pytest import fixture, mark

from tests.pages.blocks import ROOT, Runner, blocks_of, pages

PAGES = pages()
LONGEST_README = 120
"""Lines: what a newcomer reads in two minutes."""
MEAN_WORDS = 18
"""Of a sentence, in the mean of a page, at most."""
MOST_WORDS = 15_000
"""Of README and site together."""
COMMENTS = r"<!--.*?-->"

EACH = mark.parametrize("page", PAGES, ids=lambda page: page.relative_to(ROOT).as_posix())


@fixture(scope="module")
def runner(tmp_path_factory):
    return Runner(tmp_path_factory.mktemp("pages"))


@EACH
def test_blocks_run(runner, page):
    if blocks := blocks_of(page):
        runner.run(blocks)


def sentences(text: str) -> list[str]:
    """Return the sentences of a page's prose: no code, tables, headings, pictures; a point of a
    list ends a sentence.
    """
    text = re.sub(r"^```.*?^```", "", text, flags=re.MULTILINE | re.DOTALL)
    text = re.sub(COMMENTS, "", text, flags=re.DOTALL)
    text = re.sub(r"^(\||#|:::|!\[|\?\?\?|!!!).*$", "\n", text, flags=re.MULTILINE)
    text = re.sub(r"`[^`]*`", "Code", text)
    text = re.sub(r"\]\([^)]*\)", "]", text)
    points = re.split(r"\n\s*\n|^\s*(?:[-*]|\d+\.) ", text, flags=re.MULTILINE)
    parts = [
        part for point in points for part in re.split(r"(?<=[.!?:])\s+(?=[A-Z0-9`*\[])", point)
    ]
    return [part for part in parts if len(re.findall(r"\w+", part)) > 1]


def mean_words(text: str) -> float:
    """Return the mean length of a page's sentences."""
    parts = sentences(text)
    return sum(len(part.split()) for part in parts) / len(parts) if parts else 0.0


@EACH
def test_sentences_are_short(page):
    assert mean_words(page.read_text(encoding="utf-8")) < MEAN_WORDS


def test_what_counts_as_a_sentence():
    text = (
        "# No sentence\n\nOne of four words. `code a b c` is one.\n\n| a | b |\n\n- a point of five"
        " words\n```sh\nls\n```\n"
    )
    assert [len(part.split()) for part in sentences(text)] == [4, 3, 5], sentences(text)
    assert mean_words("word " * 30 + ".") > MEAN_WORDS


def test_the_readme_is_short():
    assert len((ROOT / "README.md").read_text(encoding="utf-8").splitlines()) <= LONGEST_README


def test_pages_do_not_grow():
    assert sum(len(page.read_text(encoding="utf-8").split()) for page in PAGES) <= MOST_WORDS


def test_links_and_named_files_exist():
    missing = []
    for page in [*PAGES, ROOT / "CONTRIBUTING.md"]:
        text = page.read_text(encoding="utf-8")
        named = [
            (ROOT, name)
            for name in re.findall(
                r"`((?:configs|tests|docs|visthrow|sim|camera|hil)/[\w./-]*[\w/])`", text
            )
        ]
        linked = [
            (page.parent, link.split("#")[0]) for link in re.findall(r"\]\(([^)\s]+)\)", text)
        ]
        missing += [
            f"{page.name}: {name}"
            for root, name in named + linked
            if name and "://" not in name and not (root / name).exists()
        ]
    assert not missing


def test_nothing_is_fetched():
    """A reader without a network misses nothing: no picture, script or style of another host."""
    assert not [
        p
        for p in PAGES
        if re.search(r"!\[[^\]]*\]\(https?:|src=\"https?:", p.read_text(encoding="utf-8"))
    ]
