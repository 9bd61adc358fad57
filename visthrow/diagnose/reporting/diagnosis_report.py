"""The report of a diagnosis, as text, page and JSON: a sentence for each finding, the evidence
behind it, and which manoeuvres to fly next.
"""

import dataclasses
from collections import Counter
from collections.abc import Mapping
from typing import Any

import numpy as np

from visthrow.diagnose.inputs.measures import MEASUREMENTS
from visthrow.diagnose.likelihood.evidence import ALARM
from visthrow.diagnose.likelihood.forms import HEAD_SECONDS, readable
from visthrow.diagnose.models.model_interface import Sizes
from visthrow.diagnose.reporting import pictures
from visthrow.diagnose.reporting.blind import Blind
from visthrow.diagnose.reporting.gain import Gain, LandingGain
from visthrow.diagnose.select import result
from visthrow.diagnose.select.candidates import unit_suffix
from visthrow.diagnose.select.result import ChannelGain, Diagnosis
from visthrow.view.parts import Grid, Picture, Section, Text, section

OPEN = (result.CLASS, result.NOT_IDENTIFIABLE)
"""Verdicts that more flights can change."""


def sentence_of(diagnosis: Diagnosis) -> str:
    """Return the overall verdict in a sentence."""
    where = f" in the {diagnosis.block}" if diagnosis.block else ""
    return f"{diagnosis.overall}{where}: {result.OVERALL[diagnosis.overall]}."


def summary(diagnosis: Diagnosis, gain: Gain | None = None) -> str:
    """Return the text that the command line prints."""
    lines = [sentence_of(diagnosis), *(f"  {reason}" for reason in diagnosis.reasons), ""]
    lines += [f"{word:6} {text}" for word, text in _statements(diagnosis, gain)]
    counted = Counter(f.verdict for f in diagnosis.findings)
    counts = [f"{counted[v]} {v.lower()}" for v in result.VERDICTS if v in counted]
    lines.append(", ".join(counts))
    compared = gain or diagnosis.held_out
    if compared is not None and (diagnosis.theta or gain is None):
        lines += [_gain_line(c) for c in compared.channels]
    if gain is not None and gain.landing is not None:
        lines.append(landing_sentence(gain.landing))
    lines.append(
        f"{diagnosis.windows} windows of {diagnosis.flights} flights, {diagnosis.seconds:.1f} s"
    )
    return "\n".join(lines)


def _statements(diagnosis: Diagnosis, gain: Gain | None) -> list[tuple[str, str]]:
    """Return the statements of the report, each with its heading, such as a verdict."""
    moved = gain.landing.moved if gain is not None and gain.landing is not None else {}
    measured = {m.effect: f"{m.name} (--measured {m.effect}={m.sd:g})" for m in MEASUREMENTS}
    statements = []
    for f in diagnosis.findings:
        if f.verdict not in result.NAMED:
            continue
        text = f.sentence
        if f.name in moved:
            text += f" It moves landings by {1e3 * moved[f.name]:.0f} mm."
        ways = [*f.manoeuvres, *(measured[n] for n in (f.name, *f.partners) if n in measured)]
        if f.partners and ways:
            text += f" To separate them: {'; '.join(ways)}."
        statements.append((f.verdict, text))
    statements += [("OR", line) for line in instead(diagnosis)]
    statements += [("FOUND", m.sentence) for m in diagnosis.mistakes]
    statements += [("VARIES", s.sentence) for s in diagnosis.scatter if s.found]
    statements += [("EVENT", _event(diagnosis, flight)) for flight in diagnosis.events]
    for flight, original in diagnosis.duplicates.items():
        statements.append(("COPY", f"flight {flight} repeats flight {original} and was left out"))
    return statements


def _gain_line(c: ChannelGain) -> str:
    unit, before, after, floor, box = _errors(c)
    errors = f"{before} -> {after} {unit}".rstrip()
    comparison = f"noise alone {floor}" + (f", black box {box}" if box else "")
    return (
        f"held-out error of {c.channel}: {errors}, {percent(c.gain)} % less {c.interval};"
        f" {comparison}"
    )


def _errors(c: ChannelGain) -> tuple[str, str, str, str, str]:
    """Return the unit of a channel and its prediction errors, all as text: of the original model,
    with the selected effects, of noise alone, and of the black box, which is "" without one.
    """
    factor, unit = readable(c.unit)
    before, after, floor, box = (
        "" if np.isnan(value) else f"{factor * value:.3g}"
        for value in (c.before, c.after, c.floor, c.blackbox)
    )
    return unit, before, after, floor, box


def percent(share: float, digits: int = 0) -> str:
    """Format a share in per cent; one that is rounded to 0 has no sign."""
    return f"{round(100 * share, digits) + 0.0:.{digits}f}"


def landing_sentence(landing: LandingGain) -> str:
    """Return a sentence on the errors of the predicted landings, in millimetres."""
    mm = [1e3 * x for x in (landing.before, landing.after, landing.low, landing.high)]
    released = f"{1e3 * landing.released_before:.0f} to {1e3 * landing.released_after:.0f} mm"
    if not landing.moved:
        return (
            f"The mean landing error of {landing.throws} throws is {mm[0]:.0f} mm, predicted open"
            " loop from before the throw; predicted from the separation, it is"
            f" {1e3 * landing.released_before:.0f} mm."
        )
    whose = "held-out throws" if landing.held_out else "the same throws"
    goes = f"{'falls' if mm[1] < mm[0] else 'rises'} from {mm[0]:.0f} to {mm[1]:.0f} mm"
    if round(mm[0]) == round(mm[1]):
        goes = f"stays at {mm[1]:.0f} mm"
    return (
        f"With the selected effects, the mean landing error of {landing.throws} {whose} {goes}"
        f" [{mm[2]:.0f}, {mm[3]:.0f}], predicted open loop from before the throw; predicted from"
        f" the separation, it goes from {released}."
    )


def _event(diagnosis: Diagnosis, flight: int) -> str:
    """Describe an unusual flight: effects whose sizes differ from other flights', a window with far
    stronger latent forces than its phase, or a disturbance for which the flight was left out.
    """
    differs = []
    for name, size in diagnosis.alone.items():
        effect, _, number = name.partition(" in flight ")
        if number == str(flight):
            differs.append(f"{effect} by {size:+.3g}{unit_suffix(diagnosis[effect].unit)}")
    if differs:
        return f"flight {flight} differs from the others in {', '.join(differs)}"
    if flight in {w.flight for w in diagnosis.work.after.windows}:
        return (
            f"a window of flight {flight} has far stronger latent forces than others of its phase,"
            " and has less weight"
        )
    return f"flight {flight} contains a disturbance that the others do not; it was left out"


def instead(diagnosis: Diagnosis) -> list[str]:
    """Return a line for each possible set that differs from the selected one by more than one
    effect; single alternatives are reported as a class.
    """
    lines: list[str] = []
    named = set(diagnosis.theta)
    if not diagnosis.sets or set(diagnosis.sets[0][0]) != named:  # effects were replaced by a law
        return lines
    for names, nats in diagnosis.sets:
        removed = sorted(named.difference(names))
        new = sorted(set(names) - named)
        if max(len(removed), len(new)) > 1:
            lines.append(
                f"{', '.join(new) or 'nothing'} in place of {', '.join(removed) or 'nothing'},"
                f" {nats:.1f} nats behind"
            )
    return lines


def to_json(
    diagnosis: Diagnosis,
    gain: Gain | None = None,
    blind: Blind | None = None,
    extra: Mapping[str, Any] | None = None,
) -> dict[str, Any]:
    """Return the contents of the page, with the lines of :func:`summary`, for JSON."""
    value = diagnosis.to_dict()
    value["summary"] = list(filter(None, summary(diagnosis, gain).splitlines()))
    for name, part in (("gain", gain), ("blind", blind)):
        if part is not None:
            value[name] = dataclasses.asdict(part)
    return {**value, **(extra or {})}


def sections(
    diagnosis: Diagnosis,
    gain: Gain | None = None,
    blind: Blind | None = None,
    step_check: Mapping[str, float] | None = None,
    provenance: Mapping[str, Any] | None = None,
) -> list[Section]:
    """Return all sections of the page.

    ``step_check``: channel -> largest difference between the replay and one with finer steps, in
    the sensor's standard deviations.
    """
    listed = [
        _verdict(diagnosis, gain),
        _residuals(diagnosis),
        _gain(gain, diagnosis.theta),
        _candidates(diagnosis),
        _levels(diagnosis),
        _laws(diagnosis),
        *_catalogue(diagnosis),
        _blind(blind, diagnosis),
        _list_next_flights(diagnosis),
        _ground(diagnosis, step_check or {}, provenance or {}),
    ]
    return [part for part in listed if part.parts]


def _verdict(diagnosis: Diagnosis, gain: Gain | None) -> Section:
    lines = [*diagnosis.reasons]
    lines += [f"**{word}.** {text}" for word, text in _statements(diagnosis, gain)]
    if diagnosis.explanations:
        sizes = []
        for law in diagnosis.explanations[0]:
            sizes.append(f"{law.formula} with c = {law.coefficient:.3g} ± {law.sd:.2g} {law.unit}")
        together = ", which act together" if len(sizes) > 1 else ""
        lines.append(f"**Law.** {' and '.join(sizes)}{together}.")
    picture = None
    if gain is not None and gain.landing is not None:
        lines.append(f"**Landing.** {landing_sentence(gain.landing)}")
        if gain.landing.moved:
            caption = "Predicted landings, seen from the measured ones."
            picture = Picture("landings", pictures.landings(gain.landing), caption)
    return section("verdict", "Verdict", *(Text(line, "finding") for line in lines), picture)


def _residuals(diagnosis: Diagnosis) -> Section:
    work = diagnosis.work
    drawn = []
    if diagnosis.theta:
        caption = "residuals before and after"
        if any(window.nuisance.size for window in work.after.windows):
            caption += ", with each window's initial state fitted"
        for c, name in enumerate(work.problem.model.channels):
            if any(np.any(window.channel == c) for window in work.after.windows):
                png = pictures.residuals(work, c)
                drawn.append(Picture(f"residual_{name}", png, f"{name}: {caption}."))
    return section("residuals", "Residuals before and after", *drawn)


def _gain(gain: Gain | None, named: Sizes) -> Section:
    """Return the section on prediction errors; if no effect was selected, only the original
    model's.
    """
    title = "Gain on held-out flights"
    if gain is None:
        return section("gain", title)
    rows = []
    for c in gain.channels:
        unit, before, after, floor, box = _errors(c)
        less = f"{percent(c.gain, 1)} % {c.interval}"
        worse = "worse" if c.high < 0.0 else ""
        changes = (after, less) if named else ("-", "-")
        rows.append((c.channel, unit, before, *changes, floor, box or "-", worse if named else ""))
    shares = [f"{name} in {100 * share:.0f} %" for name, share in gain.named_in.items()]
    predicted = f"predictions from the first {HEAD_SECONDS:g} s of each window"
    note = (
        f"Root mean square errors of {'whole windows' if gain.whole else predicted},"
        f" {gain.left_out} held out in {gain.folds} folds. Effects were selected again in each fold"
        f" ({', '.join(shares) or 'none in any'}). Intervals: 95 %, from the variation between"
        f" flights. Change of the log-likelihood: {gain.nats_per_sample:+.3f} nats a sample."
    )
    header = (
        "channel | unit | original model | with selected effects | reduction | noise alone |"
        " black box | "
    )
    picture = None
    if any(len(c.horizons) > 1 for c in gain.channels):
        over = "time in the window" if gain.whole else "prediction horizon"
        picture = Picture("horizons", pictures.horizons(gain), f"Error over the {over}.")
    grid = Grid.from_rows("Held-out prediction error", header, rows, note)
    return section("gain", title, grid, picture)


def _candidates(diagnosis: Diagnosis) -> Section:
    if not diagnosis.steps:
        return section("ladder", "Candidates")
    text = Text(
        "Gain in evidence [nats] of each candidate, or of a set in place of the effects selected"
        " before. Bars: by derivatives; marks: after simulating again (circle: selected, triangle:"
        " rejected); line: the threshold."
    )
    ladder = Picture("ladder", pictures.ladder(diagnosis), "Candidates of each step.")
    rows = [(", ".join(names) or "nothing", f"{nats:.1f}") for names, nats in diagnosis.sets]
    title = "Possible sets of effects"
    sets = Grid.from_rows(title, "set | nats behind", rows if len(rows) > 1 else [])
    return section("ladder", "Candidates", text, ladder, sets)


def _levels(diagnosis: Diagnosis) -> Section:
    header = "force | phase | original model | with selected effects | ratio to quietest phase | "
    rows = []
    for level in diagnosis.levels:
        sizes = (f"{level.before:.3g}", f"{level.after:.3g}", f"{level.after / level.quiet:.1f}")
        excess = "stronger than gusts" if level.excessive else ""
        rows.append((level.block, level.phase, *sizes, excess))
    note = (
        "Standard deviation of the forces [N] and torques [N m] that the model does not contain."
        " Selected effects include laws, and effects that were withdrawn later. Gusts alone would"
        " be equally strong in all phases."
    )
    grid = Grid.from_rows("Latent forces", header, rows, note, heads=2)
    return section("levels", "Unexplained forces", grid)


def _laws(diagnosis: Diagnosis) -> Section:
    rows = []
    for number, together in enumerate(diagnosis.explanations, start=1):
        for law in together:
            size = f"{law.coefficient:.4g} ± {law.sd:.2g}"
            rows.append((str(number), law.formula, law.block, size, law.unit, f"{law.nats:.1f}"))
    note = (
        "Terms with the same number act together; `apply --laws NUMBER` writes them. Nats: gain in"
        " evidence over the same effects without these terms, minus the log of the number of"
        " equally simple terms."
    )
    grid = Grid.from_rows("Terms", "number | law | acts on | c | unit | nats", rows, note, heads=3)
    return section("laws", "Laws outside the catalogue", grid)


def _catalogue(diagnosis: Diagnosis) -> list[Section]:
    """Return the sections on the sizes of all effects and on the correlations between them."""
    rows = []
    for f in diagnosis.findings:
        sizes = (f"{f.estimate:.3g}" if f.estimate else "", f"{f.low:.3g}", f"{f.high:.3g}")
        needs = f.missing or (f.manoeuvres if f.verdict in OPEN else ())
        rows.append(
            (f.name, f.verdict, f.block, *sizes, f"{f.floor:.3g}", f.unit, "; ".join(needs))
        )
    header = "effect | verdict | block | size | from | to | floor | unit | needs"
    meanings = [f"**{verdict}**: {meaning}." for verdict, meaning in result.VERDICTS.items()]
    meanings.append("An interval is for the size of the effect if it is present.")
    if diagnosis.overall == result.UNKNOWN:
        meanings.append("An unknown effect also acts, which may bias these sizes.")
    note = " ".join(meanings)
    caption = "95 % intervals of all effects, in floors."
    intervals = Picture("verdicts", pictures.verdicts(diagnosis), caption)
    grid = Grid.from_rows("All effects", header, rows, note, heads=3)
    caption = "Correlation of the estimates with every effect free."
    alike = Picture("confusion", pictures.confusion(diagnosis), caption)
    return [
        section("catalogue", "All effects of the catalogue", intervals, grid),
        section("confusion", "Correlated effects", alike),
    ]


def _blind(blind: Blind | None, diagnosis: Diagnosis) -> Section:
    title = "What these flights can detect"
    if blind is None:
        return section("blind", title)
    rows = [(c.name, "-" if np.isnan(c.limit) else f"{c.limit:.3g}", c.unit) for c in blind.curves]
    note = (
        f"Size that would be found, up to its class, in 90 % of worlds; noise: {blind.noise}. False"
        f" alarms without a hidden effect: {100 * blind.false_alarms:.2f} % of {blind.worlds}"
        " worlds."
    )
    png = pictures.completeness(blind, [f.floor for f in diagnosis.findings])
    picture = Picture("completeness", png, "Sizes from which hidden effects are found.")
    header = "effect | limit | unit"
    grid = Grid.from_rows("Detection limits in these flights", header, rows, note)
    return section("blind", title, picture, grid)


def _list_next_flights(diagnosis: Diagnosis) -> Section:
    """Return the section on the manoeuvres that the catalogue suggests for undecided effects."""
    serves: dict[str, list[str]] = {}
    for f in diagnosis.findings:
        for manoeuvre in f.manoeuvres if f.verdict in OPEN else ():
            serves.setdefault(manoeuvre, []).append(f.name)
    ranked = sorted(serves.items(), key=lambda item: -len(item[1]))
    rows = [(manoeuvre, ", ".join(names)) for manoeuvre, names in ranked]
    note = (
        "`visthrow diagnose plan` simulates them with the diagnosed model and ranks them by"
        " expected evidence."
    )
    grid = Grid.from_rows("Manoeuvres", "manoeuvre | would show or separate", rows, note)
    return section("plan", "What to fly next", grid)


def _ground(
    diagnosis: Diagnosis, step_check: Mapping[str, float], provenance: Mapping[str, Any]
) -> Section:
    null = f"exceeded by the best effect in one of {1.0 / ALARM:.0f} worlds without any effect"
    facts = {
        "flights, windows, samples": f"{diagnosis.flights}, {diagnosis.windows},"
        f" {diagnosis.samples}",
        "threshold": f"{diagnosis.threshold:.2f} nats, {null}",
        "seed of the null worlds": diagnosis.seed,
        "seconds": f"{diagnosis.seconds:.1f}",
    }
    for name, scale in diagnosis.sensor_scale.items():
        facts[f"noise of {name}, relative to the stated one"] = f"{scale:.2f}"
    for name, value in step_check.items():
        facts[f"difference from a replay with finer steps, {name}"] = f"{value:.2g} sigma"
    rows = [(str(key), str(value)) for key, value in {**facts, **provenance}.items()]
    grid = Grid.from_rows("Numbers", "quantity | value", rows, heads=2)
    return section("ground", "Basis of the diagnosis", grid)
