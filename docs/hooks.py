"""MkDocs hooks: `<!-- help: fly -->` in a page becomes what `visthrow fly --help` prints; the search works without a network."""

import os
import re

from visthrow import cli

os.environ["COLUMNS"] = "100"
PLACE = re.compile(r"<!-- help: ([\w ]+) -->")


def on_page_markdown(markdown: str, **_) -> str:
    """Fill in the help texts."""
    return PLACE.sub(lambda place: f"```text\n{help_of(place.group(1).split())}```", markdown)


def on_post_page(output: str, page, **_) -> str:
    """Take the script that the search of a site without a server needs from the site itself."""
    root = "../" * page.url.count("/")
    return output.replace("https://unpkg.com/iframe-worker/shim", f"{root}assets/iframe-worker.js")


def help_of(words: list[str]) -> str:
    """Return the help of a command or of a command's own command."""
    parser = cli.build_parser(words[0])
    for word in words:
        parser = next(a.choices[word] for a in parser._subparsers._group_actions if word in (a.choices or {}))
    return parser.format_help()
