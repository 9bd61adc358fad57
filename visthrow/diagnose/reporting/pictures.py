"""Pictures of a diagnosis, in the style of :mod:`visthrow.view.style`; each function returns a
PNG.
"""

import textwrap
from collections.abc import Mapping, Sequence

import numpy as np

from visthrow.common.toml_text import tables_beside
from visthrow.diagnose.likelihood.forms import readable, unit_of
from visthrow.diagnose.likelihood.marginal import Noise
from visthrow.diagnose.likelihood.noise_levels import ENOUGH_NATS
from visthrow.diagnose.models.model_interface import Window
from visthrow.diagnose.planning.manoeuvres import Manoeuvre
from visthrow.diagnose.reporting.blind import Blind
from visthrow.diagnose.reporting.gain import Gain, LandingGain
from visthrow.diagnose.select import result
from visthrow.diagnose.select.held_out import Work
from visthrow.diagnose.select.result import Diagnosis, SelectionStep
from visthrow.view import style
from visthrow.view.parts import png_of

WIDTH = 9.2  # [inch]
LOOKS = style.looks_of(tables_beside(__file__))
"""Part of a picture -> matplotlib's keywords."""
REFERENCE = ("x [m]", "y [m]", "z [m]", "heading [deg]", "thrust [%]")
REFERENCE += tuple(f"rate {axis} [rad/s]" for axis in "xyz")
"""Labels of the plotted columns of a reference."""
SHOWN_WINDOWS = 3
SHOWN_EFFECTS = 14  # rows and columns of the confusion picture
SHOWN_HORIZONS = (0.02, 0.05, 0.1, 0.2, 0.5, 1.0)  # ticks [s]
STEPS_ACROSS = 3
NAMES_ACROSS = 26  # letters in a line of a set's names


def _add_legend(figure) -> bytes:
    """Add the labels of a figure's first axes as a legend, and return the figure as a PNG."""
    handles, labels = figure.axes[0].get_legend_handles_labels()
    by_label = dict(zip(labels, handles))
    figure.legend(by_label.values(), by_label, loc="outside upper center", ncol=4, markerscale=2)
    return png_of(figure)


def _plain(axis, digits: Sequence[int] = (1,)) -> None:
    """Label a logarithmic axis with plain numbers instead of powers of ten.

    ``digits``: leading digits of the labelled numbers in each decade."""
    axis.get_major_locator().set_params(subs=digits)
    axis.set_major_formatter("{x:g}")
    axis.set_ticks([], minor=True)


def _name_rows(axis, names: Sequence[str], size: float) -> None:
    """Label the rows of a picture with names; ``size``: of the font [pt]."""
    axis.set_yticks(range(len(names)), names, fontsize=size)
    axis.set_ylim(-1, len(names))


def compute_residuals(window: Window, noise: Noise) -> np.ndarray:
    """Return the residuals after fitting the initial state to the whole window, in the channels'
    units, shape (N,).
    """
    weight = 1.0 / (window.sigma * noise.scale[window.channel])
    states = window.nuisance * window.nuisance_sd * weight[:, None]
    normal = states.T @ states + np.eye(states.shape[1])
    fitted = np.linalg.solve(normal, states.T @ (window.residual * weight))
    return window.residual - window.nuisance * window.nuisance_sd @ fitted


def draw_plan(base: Manoeuvre, designed: Manoeuvre, rates: Mapping[str, float]) -> bytes:
    """Draw an optimised manoeuvre over its base manoeuvre, and the best manoeuvres' expected gain.

    ``rates``: manoeuvre -> expected nats a second.
    """
    figure, axes = style.subplots(3, 3, (WIDTH, 6.2))
    for r, colour in ((base, style.BEFORE), (designed, style.AFTER)):
        percent = 100.0 * (r.thrust_factor - 1.0)
        columns = np.column_stack((r.pos_w, np.degrees(r.yaw), percent, r.rates_b)).T
        for axis, label, values in zip(axes.flat, REFERENCE, columns):
            axis.plot(r.time, values, color=colour, lw=1.0, label=r.name)
            axis.set(ylabel=label, xlabel="time [s]")
    best = sorted(rates, key=rates.get)[-6:]
    colours = [style.AFTER if name == designed.name else style.BEFORE for name in best]
    bars = axes[2, 2]
    bars.barh(best, [rates[name] for name in best], color=colours)
    bars.tick_params(axis="y", labelsize=6)
    bars.set(xlabel="expected nats a second")
    return _add_legend(figure)


def residuals(work: Work, channel: int) -> bytes:
    """Draw the residuals of a channel without and with the selected effects, in the windows that
    improve most and in a typical one.
    """
    name = work.problem.model.channels[channel]
    factor, unit = readable(unit_of(name))
    pairs = []
    for before, after in zip(work.before.windows, work.after.windows):
        rows = before.channel == channel
        if rows.any():
            old, new = (compute_residuals(w, work.after.noise)[rows] for w in (before, after))
            pairs.append(((old**2).mean() - (new**2).mean(), before, rows, old, new))
    pairs.sort(key=lambda pair: -pair[0])
    usual = pairs[len(pairs) // 2]
    chosen = [*pairs[: SHOWN_WINDOWS - 1], usual] if len(pairs) >= SHOWN_WINDOWS else pairs
    figure, axes = style.subplots(1, len(chosen), (WIDTH, 2.9), sharey=True)
    for axis, (_, before, rows, old, new) in zip(axes[0], chosen):
        time = before.time[rows]
        noise = factor * 2.0 * np.median(before.sigma[rows] * work.after.noise.scale[channel])
        axis.axhspan(-noise, noise, **LOOKS["noise"])
        axis.plot(time, factor * old, **LOOKS["residual"], **LOOKS["before"])
        axis.plot(time, factor * new, **LOOKS["residual"], **LOOKS["after"])
        axis.set(title=f"flight {before.flight}, {before.phase}", xlabel="time [s]")
    axes[0, 0].set_ylabel(f"measured - simulated [{unit}]" if unit else "measured - simulated")
    return _add_legend(figure)


def ladder(diagnosis: Diagnosis) -> bytes:
    """Draw the gain of each step's candidates in evidence, by derivatives and after simulating
    again, and the threshold; three steps a row.
    """
    steps = diagnosis.steps
    columns = min(len(steps), STEPS_ACROSS)
    down = -(-len(steps) // columns)
    height = max(sum(1.0 + 0.6 * name.count(", ") for name in step.screened) for step in steps)
    figure, axes = style.subplots(down, columns, (WIDTH, down * (0.55 + 0.27 * height)))
    for axis in axes.flat[len(steps) :]:
        axis.set_visible(False)
    for number, (axis, step) in enumerate(zip(axes.flat, steps), start=1):
        _step(axis, step)
        several = f"{step.named.count(', ') + 1} causes"
        axis.set_title(f"step {number}: {several if ', ' in step.named else step.named}")
    return png_of(figure)


def _step(axis, step: SelectionStep) -> None:
    """Draw the candidates of one step."""
    names = list(step.screened)[::-1]
    screened = [max(step.screened[n], 0.0) for n in names]
    labels = [textwrap.fill(name, NAMES_ACROSS) for name in names]
    axis.barh(labels, screened, **LOOKS["screened"])
    for name in step.refitted.keys() & set(names):
        look = LOOKS["taken" if name == step.named else "beaten"]
        axis.plot(max(step.refitted[name], 0.0), names.index(name), **look)
    axis.axvline(ENOUGH_NATS, **LOOKS["threshold"])
    axis.set(xscale="symlog", xlabel="nats")
    axis.set_xlim(0.0, 1.4 * max([ENOUGH_NATS, *screened, *step.refitted.values()]))
    _plain(axis.xaxis)
    axis.tick_params(axis="y", labelsize=8)


def verdicts(diagnosis: Diagnosis) -> bytes:
    """Draw the interval of every effect in floors, coloured by verdict."""
    colours = {
        result.FOUND: style.AFTER,
        result.CLASS: style.COLOURS[3],
        result.CANDIDATE: style.COLOURS[3],
        result.BOUNDED: style.QUIET,
        result.NOT_IDENTIFIABLE: style.COLOURS[4],
    }
    findings = [f for f in diagnosis.findings if f.verdict in colours][::-1]
    figure, axis = style.single((WIDTH, 0.8 + 0.19 * len(findings)))
    axis.axvspan(-1.0, 1.0, **LOOKS["negligible"])
    for y, f in enumerate(findings):
        colour = colours[f.verdict]
        middle = f.estimate if f.verdict in result.NAMED else 0.5 * (f.low + f.high)
        ends = np.array([f.low, f.high]) / f.floor
        axis.plot(ends, [y, y], color=colour, **LOOKS["interval"])
        marker = "o" if f.estimate else "|"
        axis.plot(middle / f.floor, y, marker, color=colour, ms=6, label=f.verdict)
    axis.axvline(0.0, **LOOKS["zero"])
    axis.set_xlabel("size in floors (grey: within the floor)")
    _name_rows(axis, [f.name for f in findings], 8)
    axis.set_xscale("symlog", linthresh=1.0, linscale=0.5)
    _plain(axis.xaxis)
    axis.tick_params(axis="x", top=True, labeltop=True)
    return _add_legend(figure)


def horizons(gain: Gain) -> bytes:
    """Draw the prediction error on held-out flights over the horizon."""
    figure, axes = style.subplots(1, len(gain.channels), (WIDTH, 2.9))
    for axis, channel in zip(axes[0], gain.channels):
        h, before, after, floor = np.array(channel.horizons).T
        axis.plot(h, before, marker="^", **LOOKS["before"])
        axis.plot(h, after, marker="o", **LOOKS["after"])
        axis.plot(h, floor, **LOOKS["floor"])
        axis.set(title=channel.channel, xlabel="horizon [s]", xscale="log", yscale="log")
        axis.set_xticks(SHOWN_HORIZONS, [f"{x:g}" for x in SHOWN_HORIZONS])
        axis.minorticks_off()
        _plain(axis.yaxis, (1, 2, 5))
    axes[0, 0].set_ylabel("error [sigma of the sensor]")
    return _add_legend(figure)


def landings(landing: LandingGain) -> bytes:
    """Draw the predicted landing of each throw relative to the measured one."""
    figure, axis = style.single((WIDTH, 3.6))
    before = 1e3 * landing.off_before
    after = 1e3 * landing.off_after
    axis.plot(*before.T, **LOOKS["landing_before"], **LOOKS["before"])
    axis.plot(*after.T, **LOOKS["landing_after"], **LOOKS["after"])
    axis.plot(*np.stack((before, after)).transpose(2, 0, 1), **LOOKS["miss"])
    axis.plot(0.0, 0.0, **LOOKS["landing"])
    axis.set(xlabel="x [mm]", ylabel="y [mm]", aspect="equal")
    return _add_legend(figure)


def confusion(diagnosis: Diagnosis) -> bytes:
    """Draw the correlations of the effects' estimates with all effects free, which show what these
    flights cannot separate.
    """
    work = diagnosis.work
    visible = np.flatnonzero(work.problem.priors.visible)
    sigma = work.after.posterior.covariance(visible)[np.ix_(visible, visible)]
    deviation = np.sqrt(np.diag(sigma))
    correlation = sigma / np.outer(deviation, deviation)
    others = np.abs(correlation - np.eye(len(visible)))
    strongest = others.max(axis=1, initial=0.0)
    strongest[np.isin(visible, work.active)] = 2.0
    strongest_effects = np.sort(np.argsort(-strongest, kind="stable")[:SHOWN_EFFECTS])
    names = [work.problem.model.effects[j].name for j in visible[strongest_effects]]
    figure, axis = style.single((WIDTH, 1.6 + 0.3 * len(strongest_effects)))
    block = correlation[np.ix_(strongest_effects, strongest_effects)]
    image = axis.imshow(block, vmin=-1.0, vmax=1.0, cmap="RdBu_r")
    for (i, j), value in np.ndenumerate(block):
        if i != j and abs(value) > 0.3:
            colour = "white" if abs(value) > 0.7 else style.INK
            axis.text(j, i, f"{value:.2f}", color=colour, **LOOKS["correlation"])
    axis.set_xticks(range(len(strongest_effects)), names, rotation=60, ha="right", fontsize=8)
    axis.set_yticks(range(len(strongest_effects)), names, fontsize=8)
    figure.colorbar(image, ax=axis, shrink=0.7, label="correlation")
    return png_of(figure)


def completeness(blind: Blind, floors: Sequence[float]) -> bytes:
    """Draw the sizes from which each hidden effect is found in 50 % and in 90 % of worlds, in
    floors, with an arrow to the right where 90 % is never reached.
    """
    pairs = [(c, f) for c, f in zip(blind.curves, floors) if len(c.sizes)]
    pairs.sort(key=lambda pair: np.nan_to_num(pair[0].limit / pair[1], nan=np.inf), reverse=True)
    figure, axis = style.single((WIDTH, 0.8 + 0.17 * len(pairs)))
    for y, (curve, floor) in enumerate(pairs):
        sizes = curve.sizes / floor
        share = np.maximum.accumulate(curve.up_to_class)
        half, top = np.interp((0.5, 0.9), share, sizes)
        axis.plot((half, top), (y, y), color=style.QUIET, **LOOKS["interval"])
        axis.plot(top, y, **LOOKS["reached" if share[-1] >= 0.9 else "never"])
    axis.set(
        xscale="log",
        xlabel=(
            "hidden size [floors] found in 50 % and (mark) 90 % of worlds; >: at none of the tested"
            " sizes"
        ),
    )
    _name_rows(axis, [curve.name for curve, _ in pairs], 7)
    _plain(axis.xaxis, (1, 2, 5))
    return png_of(figure)
