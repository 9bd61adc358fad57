"""The report of a diagnosis: one page with a sentence a finding, what it rests on and what to fly
next; and the same as JSON.
"""

import dataclasses
from collections.abc import Mapping
from typing import Any

import numpy as np

from visthrow.diagnose.inputs.measures import MEASUREMENTS
from visthrow.diagnose.likelihood.forms import HEAD_SECONDS
from visthrow.diagnose.reporting import pictures
from visthrow.diagnose.reporting.blind import Blind
from visthrow.diagnose.reporting.gain import Gain, LandingGain
from visthrow.diagnose.select import result
from visthrow.diagnose.select.result import ChannelGain, Diagnosis
from visthrow.view.parts import Grid, Picture, Section, Text


def sentence_of(diagnosis: Diagnosis) -> str:
    """The overall verdict in a sentence."""
    where = f" in the {diagnosis.block}" if diagnosis.block else ""
    return f"{diagnosis.overall}{where}: {result.OVERALL[diagnosis.overall]}."


def summary(diagnosis: Diagnosis, gain: Gain | None = None) -> str:
    """Return the text that the command line prints."""
    lines = [sentence_of(diagnosis), *(f"  {reason}" for reason in diagnosis.reasons), ""]
    lines += [f"{word:6} {text}" for word, text in _statements(diagnosis, gain)]
    counted = {v: sum(f.verdict == v for f in diagnosis.findings) for v in result.VERDICTS}
    lines.append(
        ", ".join(f"{count} {verdict.lower()}" for verdict, count in counted.items() if count)
    )
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
    """Return the findings, each with its verdict."""
    moved = gain.landing.moved if gain is not None and gain.landing is not None else {}
    moves = {name: f" It moves landings by {1e3 * size:.0f} mm." for name, size in moved.items()}
    named = [f for f in diagnosis.findings if f.verdict in result.NAMED]
    measured = {m.effect: f"{m.name} (--measured {m.effect}={m.sd:g})" for m in MEASUREMENTS}
    separations = {}
    for f in named:
        ways = [*f.manoeuvres, *(measured[n] for n in (f.name, *f.partners) if n in measured)]
        if f.partners and ways:
            separations[f.name] = f" To tell them apart: {'; '.join(ways)}."
    named_findings = [
        (f.verdict, f.sentence + moves.get(f.name, "") + separations.get(f.name, "")) for f in named
    ]
    named_findings += [("OR", line) for line in instead(diagnosis)]
    named_findings += [("FOUND", m.sentence) for m in diagnosis.mistakes]
    named_findings += [("VARIES", s.sentence) for s in diagnosis.scatter if s.found]
    named_findings += [("EVENT", _event(diagnosis, flight)) for flight in diagnosis.events]
    return named_findings + [
        ("COPY", f"flight {flight} repeats flight {original} and was left out")
        for flight, original in diagnosis.duplicates.items()
    ]


def _gain_line(c: ChannelGain) -> str:
    unit, before, after, floor, box = _errors(c)
    errors = f"{before} -> {after} {unit}".rstrip()
    comparison = f"noise alone {floor}" + (f", black box {box}" if box else "")
    return (
        f"held-out error of {c.channel}: {errors}, {percent(c.gain)} % less {c.interval};"
        f" {comparison}"
    )


def _errors(c: ChannelGain) -> tuple[str, str, str, str, str]:
    """Unit and errors of a channel as text: as it stands, with what was named, of noise alone, of
    the black box if there is one.
    """
    factor, unit = pictures.READABLE.get(c.unit, (1.0, c.unit))
    values = (c.before, c.after, c.floor, c.blackbox)
    return (unit, *("" if np.isnan(value) else f"{factor * value:.3g}" for value in values))


def percent(share: float, digits: int = 0) -> str:
    """A share in per cent, without sign where it is nothing."""
    return f"{round(100 * share, digits) + 0.0:.{digits}f}"


def landing_sentence(landing: LandingGain) -> str:
    """Return a sentence on the model's predicted landings, in millimetres."""
    mm = [1e3 * x for x in (landing.before, landing.after, landing.low, landing.high)]
    released = f"{1e3 * landing.released_before:.0f} to {1e3 * landing.released_after:.0f} mm"
    if not landing.moved:
        return (
            f"{landing.throws} throws, predicted open loop from before the throw, land {mm[0]:.0f}"
            " mm off where they were seen to; from the separation on"
            f" {1e3 * landing.released_before:.0f} mm."
        )
    whose = "held-out throws" if landing.held_out else "the same throws"
    goes = f"{'falls' if mm[1] < mm[0] else 'rises'} from {mm[0]:.0f} to {mm[1]:.0f} mm"
    if round(mm[0]) == round(mm[1]):
        goes = f"stays at {mm[1]:.0f} mm"
    return (
        f"With what was named the landing error of {landing.throws} {whose} {goes} [{mm[2]:.0f},"
        f" {mm[3]:.0f}], open loop from before the throw; from the separation on {released}."
    )


def _event(diagnosis: Diagnosis, flight: int) -> str:
    """Return what happened in a flight: in one that was left out, or in one with a window far
    rougher than its phase.
    """
    if diagnosis.work is not None and flight in {w.flight for w in diagnosis.work.after.windows}:
        return (
            f"something happened in flight {flight} that the rest of its phase does not show; there"
            " the flight weighs little"
        )
    return f"something happened in flight {flight} that the others do not show; it was left out"


def instead(diagnosis: Diagnosis) -> list[str]:
    """A line for each set of causes that says the same with several others; single ones that do are
    told as a class.
    """
    lines = []
    named = set(diagnosis.theta)
    withdrawn = not diagnosis.sets or set(diagnosis.sets[0][0]) != named  # for a law
    for names, nats in () if withdrawn else diagnosis.sets:
        removed = sorted(named - set(names))
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
    """Everything the page says, as plain data."""
    value = diagnosis.to_dict()
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
    """All sections of the page; ``step_check``: channel -> largest difference between the replay
    and one with finer steps, in sigmas.
    """
    parts = [_verdict(diagnosis, gain)]
    work = diagnosis.work
    if work is not None and diagnosis.theta:
        parts.append(_residuals(work))
    if gain is not None:
        parts.append(_gain(gain, diagnosis))
    if diagnosis.steps:
        parts.append(_candidates(diagnosis))
    if diagnosis.levels:
        parts.append(_levels(diagnosis))
    if diagnosis.laws:
        parts.append(_laws(diagnosis))
    if work is not None:
        parts.append(_catalogue(diagnosis))
        caption = "Correlation of the estimates with every effect free."
        alike = Picture("confusion", pictures.confusion(diagnosis), caption)
        parts.append(Section("confusion", "What looks alike", (alike,)))
    if blind is not None:
        parts.append(_blind(blind, diagnosis))
    parts += _next_flights(diagnosis)
    parts.append(_ground(diagnosis, step_check, provenance))
    return parts


def _residuals(work: Any) -> Section:
    fitted = any(w.nuisance.size for w in work.after.windows)
    caption = "residuals before and after"
    caption += ", with each window's initial state fitted." if fitted else "."
    drawn = tuple(
        Picture(f"residual_{name}", pictures.residuals(work, c), f"{name}: {caption}")
        for c, name in enumerate(work.problem.model.channels)
        if any(np.any(w.channel == c) for w in work.after.windows)
    )
    return Section("residuals", "Residuals before and after", drawn)


def _candidates(diagnosis: Diagnosis) -> Section:
    text = Text(
        "Nats of evidence that each candidate would bring, or a set in place of the names"
        " before; as a line what it must exceed; marks: with the simulation run again (circle:"
        " taken, triangle: beaten)."
    )
    parts = [text, Picture("ladder", pictures.ladder(diagnosis), "Ladder of candidates.")]
    rows = tuple((", ".join(names) or "nothing", f"{nats:.1f}") for names, nats in diagnosis.sets)
    if len(rows) > 1:
        title = "Sets of causes that explain the flights as well"
        parts.append(Grid(title, ("set", "nats behind"), rows))
    return Section("ladder", "Candidates", tuple(parts))


def _verdict(diagnosis: Diagnosis, gain: Gain | None) -> Section:
    parts: list[Text | Picture] = [Text(reason, "finding") for reason in diagnosis.reasons]
    parts += [Text(f"**{word}.** {text}", "finding") for word, text in _statements(diagnosis, gain)]
    if diagnosis.overall == result.UNKNOWN and diagnosis.laws:
        law = diagnosis.laws[0]
        parts.append(
            Text(
                f"**Law.** {law.formula} with c = {law.coefficient:.3g} ± {law.sd:.2g} {law.unit}.",
                "finding",
            )
        )
    if gain is not None and gain.landing is not None:
        parts.append(Text(f"**Landing.** {landing_sentence(gain.landing)}", "finding"))
        if gain.landing.moved:
            parts.append(
                Picture(
                    "landings",
                    pictures.landings(gain.landing),
                    "Predicted landings, seen from the measured ones.",
                )
            )
    return Section("verdict", "Verdict", tuple(parts))


def _gain(gain: Gain, diagnosis: Diagnosis) -> Section:
    title = "Gain on flights that were not used"
    rows = []
    for c in gain.channels:
        unit, before, after, floor, box = _errors(c)
        less = f"{percent(c.gain, 1)} % {c.interval}"
        rows.append(
            (
                c.channel,
                unit,
                before,
                after,
                less,
                floor,
                box or "-",
                "worse" if c.high < 0.0 else "",
            )
        )
    named = (
        ", ".join(f"{name} in {100 * share:.0f} %" for name, share in gain.named_in.items())
        or "nothing in any"
    )
    channels = (
        "whole windows"
        if gain.whole
        else f"predictions from the first {HEAD_SECONDS:g} s of each window"
    )
    note = (
        f"Root mean square errors of {channels}, {gain.left_out} left out in {gain.folds} "
        f"folds, the"
        f" selection repeated in each ({named}). Interval: 95 %, jackknife over flights."
        f" Log-likelihood: {gain.nats_per_sample:+.3f} nats a sample."
    )
    header = (
        "channel",
        "unit",
        "as it stands",
        "with what was named",
        "less",
        "noise alone",
        "black box",
        "",
    )
    grid = Grid("Held-out prediction error", header, tuple(rows), note)
    if all(len(c.horizons) < 2 for c in gain.channels):
        return Section("gain", title, (grid,))
    caption = (
        "Error over the time in the window."
        if gain.whole
        else "Error over the horizon of the prediction."
    )
    return Section("gain", title, (grid, Picture("horizons", pictures.horizons(gain), caption)))


def _levels(diagnosis: Diagnosis) -> Section:
    rows = tuple(
        (
            level.block,
            level.phase,
            f"{level.before:.3g}",
            f"{level.after:.3g}",
            f"{level.after / level.quiet:.1f}",
            "more than gusts" if level.excessive else "",
        )
        for level in diagnosis.levels
    )
    header = (
        "what",
        "phase",
        "as it stands",
        "with what was named",
        "times the quietest phase",
        "",
    )
    note = (
        "Deviation of what moves the vehicle besides the model [N; N m]. Gusts do not know the"
        " phase of the flight."
    )
    return Section(
        "levels",
        "Forces that nothing explains",
        (Grid("Latent forces", header, rows, note, heads=2),),
    )


def _laws(diagnosis: Diagnosis) -> Section:
    rows = tuple(
        (
            law.formula,
            law.block,
            f"{law.coefficient:.4g} ± {law.sd:.2g}",
            law.unit,
            f"{law.nats:.1f}",
        )
        for law in diagnosis.laws
    )
    note = (
        "Nats over the same causes without the term, less the log of the number of terms as simple"
        " as it."
    )
    return Section(
        "laws",
        "Laws outside the catalogue",
        (Grid("Terms", ("law", "on", "c", "unit", "nats"), rows, note),),
    )


def _catalogue(diagnosis: Diagnosis) -> Section:
    rows = tuple(
        (
            f.name,
            f.verdict,
            f.block,
            f"{f.estimate:.3g}" if f.estimate else "",
            f"{f.low:.3g}",
            f"{f.high:.3g}",
            f"{f.floor:.3g}",
            f.unit,
            "; ".join(
                f.missing
                or (f.manoeuvres if f.verdict in (result.CLASS, result.NOT_IDENTIFIABLE) else ())
            ),
        )
        for f in diagnosis.findings
    )
    header = ("effect", "verdict", "block", "size", "from", "to", "floor", "unit", "needs")
    note = " ".join(f"**{verdict}**: {meaning}." for verdict, meaning in result.VERDICTS.items())
    parts = (
        Picture(
            "verdicts",
            pictures.verdicts(diagnosis),
            "95 % intervals of all effects in their floors.",
        ),
        Grid("All effects", header, rows, note, heads=3),
    )
    return Section("catalogue", "Every effect of the catalogue", parts)


def _blind(blind: Blind, diagnosis: Diagnosis) -> Section:
    rows = tuple(
        (c.name, "-" if np.isnan(c.limit) else f"{c.limit:.3g}", c.unit) for c in blind.curves
    )
    floors = [f.floor for f in diagnosis.findings]
    note = (
        f"Size that would be named, up to its class, in 90 % of worlds; noise: {blind.noise}. False"
        f" alarms without a hidden effect: {100 * blind.false_alarms:.2f} % of {blind.worlds}"
        " worlds."
    )
    parts = (
        Picture(
            "completeness",
            pictures.completeness(blind, floors),
            "Sizes from which hidden effects are named.",
        ),
        Grid("Detection limits in these flights", ("effect", "limit", "unit"), rows, note),
    )
    return Section("blind", "What these flights can detect", parts)


def _next_flights(diagnosis: Diagnosis) -> list[Section]:
    """Manoeuvres that the catalogue names for what stays open."""
    open_ones = (result.CLASS, result.NOT_IDENTIFIABLE)
    serves: dict[str, list[str]] = {}
    for f in diagnosis.findings:
        for manoeuvre in f.manoeuvres if f.verdict in open_ones else ():
            serves.setdefault(manoeuvre, []).append(f.name)
    ranked = sorted(serves.items(), key=lambda item: -len(item[1]))
    rows = tuple((manoeuvre, ", ".join(names)) for manoeuvre, names in ranked)
    note = (
        "`visthrow diagnose plan` simulates them in these flights' model and ranks them by what"
        " they would tell."
    )
    grid = Grid("Manoeuvres", ("manoeuvre", "would show or separate"), rows, note)
    return [Section("plan", "What to fly next", (grid,))] if rows else []


def _ground(
    diagnosis: Diagnosis,
    step_check: Mapping[str, float] | None,
    provenance: Mapping[str, Any] | None,
) -> Section:
    rows = [
        (
            "flights, windows, samples",
            f"{diagnosis.flights}, {diagnosis.windows}, {diagnosis.samples}",
        ),
        (
            "threshold",
            (
                f"{diagnosis.threshold:.2f} nats, exceeded by the best of all effects in 0.5 % of"
                " null worlds"
            ),
        ),
        ("seed of the null worlds", str(diagnosis.seed)),
        ("seconds", f"{diagnosis.seconds:.1f}"),
    ]
    rows += [
        (f"noise of {name} in what was stated", f"{scale:.2f}")
        for name, scale in diagnosis.sensor_scale.items()
    ]
    rows += [
        (f"replay against finer steps, {name}", f"{value:.2g} sigma")
        for name, value in (step_check or {}).items()
    ]
    rows += [(str(key), str(value)) for key, value in (provenance or {}).items()]
    return Section(
        "ground", "What this rests on", (Grid("Numbers", ("what", "value"), tuple(rows), heads=2),)
    )
