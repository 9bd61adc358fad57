"""The runner of blocks catches a page that shows what does not work."""

from pytest import mark, raises

from tests.pages.blocks import ROOT, Runner, blocks_of, pages


def run(tmp_path, text):
    page = tmp_path / "page.md"
    page.write_text(text)
    (tmp_path / "work").mkdir()
    runner = Runner(tmp_path / "work")
    runner.run(blocks_of(page, root=tmp_path))
    return runner


GOOD = """
```toml title="mine.toml"
base = "paper.toml"
```
```sh
visthrow config vehicle mine.toml  # a remark
echo x > made.txt
```
```text
mass = 0.211
```
<!-- not run: a GPU -->
```sh
visthrow train state
```
```python
from pathlib import Path
assert Path("made.txt").read_text() == "x\\n"
```
"""


def test_a_good_page_runs_and_nothing_runs_twice(tmp_path, capfd):
    page = tmp_path / "page.md"
    page.write_text(GOOD)
    runner = Runner(tmp_path)
    runner.run(blocks_of(page, root=tmp_path))
    assert capfd.readouterr().out
    (tmp_path / "again.md").write_text(GOOD)
    runner.run(blocks_of(tmp_path / "again.md", root=tmp_path))
    assert not capfd.readouterr().out
    assert (tmp_path / "again_md" / "made.txt").exists()


@mark.parametrize(
    ("text", "message"),
    [
        ("```sh\nfalse\n```\n", "status 1"),
        ("```sh\nvisthrow config vehicle nobody\n```\n", "status 2"),
        ("```sh\nvisthrow fly --no-such-option\n```\n", "2"),
        ("```python\nassert 1 == 2, 'wrong'\n```\n", "wrong"),
        ("<!-- not run: a GPU -->\n```sh\nvisthrow train --no-such-option\n```\n", "2"),
        (
            "```sh\nvisthrow config vehicle paper\n```\n```text\nmass = 0.40\n```\n",
            "the page shows",
        ),
        ("```toml\nbase = 'x'\n```\n", "give it a title"),
        ('```toml title="lonely.toml"\nbase = "x"\n```\n', "nothing on the page uses lonely.toml"),
        (
            "<!-- terminals -->\n```sh\nvisthrow config nothing\nvisthrow config vehicle\n```\n",
            r"statuses \[2, 0\]",
        ),
    ],
)
def test_what_does_not_run_fails(tmp_path, text, message):
    with raises((AssertionError, SystemExit), match=message):
        run(tmp_path, text)


@mark.parametrize(
    ("text", "message"),
    [
        ("<!-- not run: no idea -->\n```sh\nfalse\n```\n", "no reason"),
        ("```\nvisthrow fly\n```\n", "without a language"),
        ("- a point\n  ```sh\n  false\n  ```\n", "indented"),
        ("<!-- skip -->\n```sh\nfalse\n```\n", "unknown comment"),
        ("```sh\nfalse\n", "not closed"),
    ],
)
def test_what_hides_a_block_fails(tmp_path, text, message):
    page = tmp_path / "page.md"
    page.write_text(text)
    with raises(ValueError, match=message):
        blocks_of(page, root=tmp_path)


def test_all_pages_are_read():
    names = {page.relative_to(ROOT).as_posix() for page in pages()}
    assert {"README.md", "docs/index.md"} <= names
