"""The report: queries of the book, statistics in its tables, messages for missing results, and the
page.
"""

import re

import numpy as np
from numpy.random import default_rng
from pytest import approx, fixture

from bench import baseline as baseline_record
from tests.unit.on_paper import made_up_results as made_up
from visthrow.common.statistics import Interval
from visthrow.paper import results
from visthrow.paper.commands import report_command as command
from visthrow.paper.report import ablations, charts, gap, result_set, throws
from visthrow.paper.results import Result
from visthrow.view import page
from visthrow.view.parts import Grid, Picture, Text


@fixture(scope="module")
def full():
    return made_up.make_shipped_book()


@fixture(scope="module")
def written(full, tmp_path_factory):
    folder = tmp_path_factory.mktemp("report")
    sections = command.sections(full)
    page.write(folder, command.TITLE, command.LEAD, sections)
    return folder, sections


def grids(section) -> list[Grid]:
    return [part for part in section.parts if isinstance(part, Grid)]


def texts(section, kind: str) -> str:
    return "\n".join(
        part.text for part in section.parts if isinstance(part, Text) and part.kind == kind
    )


def only(*entries) -> result_set.ResultSet:
    return result_set.ResultSet(tuple(entries))


def test_records_and_folders_are_read_and_batches_joined(tmp_path, full):
    rng = default_rng(0)
    parts = []
    for batch in (0, 1):
        one = made_up.policy(rng, "state", "state", "reference", 2.0, count=4)
        parts.append(Result({**one.unit, "batch": batch}, one.columns, made_up.MADE))
    old = Result(
        {**parts[0].unit, "batch": 2, "protocol": results.PROTOCOL - 1},
        parts[0].columns,
        made_up.MADE,
    )
    results.pack([*parts, old], tmp_path / "throws" / "x.json")
    (tmp_path / "findings").mkdir()
    (tmp_path / "findings" / "front.md").write_text("Why.\n")
    book = result_set.read([tmp_path])
    assert [len(r.good) for r in book.results] == [8]
    assert book.findings == {"front": "Why."}


def test_an_empty_book_says_everything_that_is_missing(tmp_path):
    sections = command.sections(result_set.ResultSet(()))
    for section in sections:
        assert texts(section, "missing"), section.name
        assert not any(isinstance(part, Picture) for part in section.parts), section.name
    html = page.html_of("t", "l", sections)
    assert html.count('class="missing"') >= len(sections)


def test_difference_of_vision_has_the_right_sign():
    rng = default_rng(1)
    near = made_up.policy(rng, "vision", "vision", "hybrid", 2.0, 0.01)
    far = made_up.policy(rng, "state", "state", "hybrid", 2.0, 0.05)
    (row,) = grids(throws.vision_section(only(near, far)))[0].rows
    assert row[3].startswith("-0.0")
    assert row[4] == "vision is better"
    assert row[6] == "-0.004, -0.029"


def test_sight_that_doubles_the_error_has_a_ratio_of_two():
    rng, variant = default_rng(3), next(name for name in gap.TRAINED if name != "full")
    thrown = [
        made_up.policy(rng, name, "vision", "hybrid", 2.0, spread, variant=name, count=500)
        for name, spread in (("full", 0.02), (variant, 0.04))
    ]
    rows = {row[0]: row for row in grids(gap.section(only(*thrown)))[-1].rows}
    assert float(rows[gap.TRAINED[variant]][5].split(" ")[0]) == approx(2.0, abs=0.2)


def test_ablation_ratio_bias_and_the_verdict():
    """Twice the spread is twice the error; a shift along the throw is reported as overshoot; equal
    spread as no effect.
    """
    rng = default_rng(2)

    def trained(variant: str, spread: float, offset=(0.0, 0.0)) -> list[Result]:
        return [
            made_up.policy(
                rng,
                f"{variant}-{seed}",
                "state",
                "reference-realistic",
                2.0,
                spread,
                offset,
                variant=variant,
                train_seed=seed,
                count=200,
            )
            for seed in (1, 2, 3)
        ]

    cable = trained("rigid_cable", 0.02, (0.1, 0.0))
    book = only(
        *trained("full", 0.02),
        *trained("no_motor_lag", 0.04),
        *cable,
        *trained("no_aerodynamics", 0.02),
    )
    section = ablations.section(book)
    rows = {row[0]: row for row in grids(section)[0].rows}
    assert float(rows["no motor lag"][5].split(" [")[0]) == approx(2.0, abs=0.15)
    assert rows["no motor lag"][6].startswith("2.4 [")
    assert rows["rigid cable"][11] == "overshoots"
    assert rows["rigid cable"][12] == "undershoots"
    findings = texts(section, "finding")
    assert re.search(r"no aerodynamics\*\*.*no effect shows; the paper: 3\.26", findings)
    assert re.search(r"no motor lag\*\*.*the component matters; the paper: 2\.42", findings)


def test_the_page_stands_alone(written):
    folder, sections = written
    html = (folder / "report.html").read_text(encoding="utf-8")
    pictures = [part for section in sections for part in section.parts if isinstance(part, Picture)]
    assert pictures
    assert html.count("data:image/png;base64,") == len(pictures)
    assert not re.search(r'(?:src|href)="(?!data:|#)', html)
    assert "<script" not in html
    assert 'class="why">Because <b>this</b> was so.' in html
    assert "&lt;b&gt;" not in html
    text = (folder / "report.md").read_text(encoding="utf-8")
    for picture in pictures:
        assert (folder / f"{picture.name}.png").read_bytes() == picture.png
        assert f"({picture.name}.png)" in text


def test_the_command_reports_from_records(tmp_path, full, refused, printed):
    results.pack(full.results, tmp_path / "records" / "throws" / "shipped.json")
    out = tmp_path / "out"
    text = printed(f"report --records {tmp_path}/records --out {out}")
    assert "realistic reference plant" in text
    assert "0 trainings" in text
    assert (out / "report.html").stat().st_size > 50_000
    for option in ("--results", "--records"):
        refused(f"report {option} {tmp_path}/none --out {tmp_path}/other", message="no such folder")
        refused(f"report {option} {tmp_path} --out {tmp_path}/other", message="in it; expected")
        assert not (tmp_path / "other").exists()


def test_what_the_report_stands_on_is_stated_once():
    keys = [results.key_of(unit) for unit in baseline_record.list_units()]
    assert len(set(keys)) == len(keys)
    assert {unit["target"] for unit in baseline_record.list_units()} == {1.5, 2.0, 2.5}


def test_pictures_show_what_they_are_given():
    """Other numbers give another picture."""

    def drawn(scale: float) -> list[bytes]:
        size = Interval(scale, 0.9 * scale, 1.1 * scale)
        first = charts.Line("a", [1.0, 2.0], [size, size], trained_at=0)
        other = charts.Line("b", [1.0, 2.0], [size, size], series=1)
        panels = [charts.Panel("both", "x", (first, other)), charts.Panel("none", "x", ())]
        points = scale * np.array([[1.0, 0.2], [2.0, 0.1]])
        trade = charts.Trade("t", ((0, "f", points),), (("s", size, size),), (("c", points),))
        runs = [("g", [points.T])]
        curves = [charts.curves(panels, "y", log) for log in (False, True)]
        return [*curves, charts.trades([trade]), charts.draw_learning(runs)]

    assert all(one != other for one, other in zip(drawn(1.0), drawn(1.5), strict=True))
