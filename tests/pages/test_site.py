"""The built site in a browser: width on a phone, dark mode, search and links.

Needs ``out/site`` (``make docs``) and Chromium; ``make test-site`` runs it.
"""

import html
import json
import re
import shutil
import subprocess
from pathlib import Path
from urllib.parse import unquote, urlsplit

from pytest import fixture, mark

from tests.pages.blocks import ROOT

pytestmark = mark.site
SITE = ROOT / "out" / "site"
PROBE = ROOT / "tests" / "pages" / "site_probe.html"
PHONE = 400  # px, as in the probe
BUDGET = 120_000  # ms of the browser's own clock, which runs as fast as the pages load
PATIENCE = 300  # s
OPTIONS = [
    "--headless",
    "--no-sandbox",
    "--disable-gpu",
    "--no-first-run",
    "--disable-sync",
    "--disable-quic",
    "--disable-background-networking",
    "--disable-component-update",
    "--allow-file-access-from-files",
    "--window-size=1400,1000",
    "--dump-dom",
]


@fixture(scope="module")
def result(tmp_path_factory):
    """Return what the probe measures of a copy of the site."""
    browser = shutil.which("chromium") or shutil.which("google-chrome")
    assert browser, "no Chromium; install Debian's package chromium"
    assert (SITE / "index.html").exists(), "no site; run `make docs`"
    folder = tmp_path_factory.mktemp("site") / "site"
    shutil.copytree(SITE, folder)
    pages = [
        path.relative_to(folder).as_posix()
        for path in sorted(folder.rglob("*.html"))
        if path.name != "404.html"
    ]
    probe = PROBE.read_text(encoding="utf-8")
    assert "const PAGES = [];" in probe
    probe = probe.replace("const PAGES = [];", f"const PAGES = {json.dumps(pages)};")
    (folder / "probe.html").write_text(probe, encoding="utf-8")
    profile = tmp_path_factory.mktemp("profile")
    command = [browser, *OPTIONS, f"--virtual-time-budget={BUDGET}", f"--user-data-dir={profile}"]
    done = subprocess.run(
        [*command, (folder / "probe.html").as_uri()],
        capture_output=True,
        text=True,
        timeout=PATIENCE,
    )
    printed = re.search(r'<pre id="result">(.*?)</pre>', done.stdout, re.DOTALL)
    assert printed, done.stderr[-2000:]
    return json.loads(html.unescape(printed[1]))


def test_no_page_is_wider_than_a_phone(result):
    wide = {page: m["width"] for page, m in result["pages"].items() if m["width"] > PHONE}
    assert not wide


def test_dark_mode_is_dark_and_dims_pictures(result):
    for page, m in result["pages"].items():
        red, green, blue = (int(part) for part in re.findall(r"\d+", m["dark"])[:3])
        assert max(red, green, blue) < 80, page
        assert not m["picture"] or "brightness" in m["picture"], page


def test_search_finds_the_page(result):
    assert any("pilots/betaflight.html" in link for link in result["search"]), result["search"]


def test_links_inside_the_site_lead_somewhere(result):
    missing = set()
    for page, m in result["pages"].items():
        for link in m["links"]:
            parts = urlsplit(link)
            if parts.scheme == "file" and not Path(unquote(parts.path)).exists():
                missing.add(f"{page}: {link}")
    assert not missing
