"""What ledgers of sealed worlds say: accuracy, completeness, coverage, gain against the oracle; with intervals.

    python -m tests.diagnose.ledger ledger.jsonl [more.jsonl] --out FOLDER     # prints Markdown, draws completeness.png

A world in which the tool failed counts as one in which nothing was named. One whose verdict was not waited for, because the bank's
time was over, counts for nothing but the column that says how many there are.
"""

import argparse
import json
import math
from collections import defaultdict
from collections.abc import Callable, Iterable, Sequence
from itertools import pairwise
from pathlib import Path
from statistics import NormalDist

import numpy as np

from tests.diagnose.sealed import NOT_WAITED, TERMS, near
from tests.worlds.world import FLOORS

LIMITS = {
    "rope_length": (3e-3, 1e3, "mm"), "cmd_delay": (4e-3, 1e3, "ms"), "motor_tau": (4e-3, 1e3, "ms"),
    "release_lag": (8e-3, 1e3, "ms"), "payload_drag": (6.1e-4, 1e4, "1e-4 kg/m"), "wind_x": (0.15, 1.0, "m/s"),
    "com_x": (5e-4, 1e3, "mm"), "marker_rot_x": (math.radians(0.2), math.degrees(1.0), "deg"),
    "frame_tilt_x": (math.radians(0.2), math.degrees(1.0), "deg"), "thrust_gain": (0.01, 100.0, "%"),
}  # fmt: skip
"""Effect -> limit that is asked for (SI; the payload's drag is that of 0.3 of a ball's coefficient), factor and unit to print."""

LEVELS = (50, 80, 95)
MATTERS = 5.0
"""Nats on unseen throws that the truth must be worth for a gain to be counted."""
HARM, HARM_NATS = 1.01, 3.0
"""Growth of the error on unseen throws, per sample in its deviations, and fall of their log likelihood, that count as harm."""
RIDGE, STEPS = 0.05, 30
"""Of the logistic curves: inverse variance of the prior of both coefficients, and Newton's steps."""
DRAWS = 400
FEWEST = 6
"""Worlds of an effect for a curve of its own."""


def wilson(k: int, n: int, level: float = 0.95) -> tuple[float, float, float]:
    """Share k / n with Wilson's interval (Wilson 1927)."""
    if n == 0:
        return math.nan, math.nan, math.nan
    z = NormalDist().inv_cdf(0.5 + 0.5 * level)
    centre, half = (k + 0.5 * z * z) / (n + z * z), z / (n + z * z) * math.sqrt(k * (n - k) / n + 0.25 * z * z)
    return k / n, max(centre - half, 0.0), min(centre + half, 1.0)


def share(k: int, n: int) -> str:
    """``12/14 = 86 % [60, 96]``."""
    if not n:
        return "-"
    value, low, high = wilson(k, n)
    return f"{k}/{n} = {100 * value:.0f} % [{100 * low:.0f}, {100 * high:.0f}]"


def logistic(size: np.ndarray, named: np.ndarray) -> tuple[float, float]:
    """Intercept and slope (0 or more) of ``log odds of being named = a + b log size``, by Newton's steps.

    A weak normal prior on both, about the middle of the sizes, keeps a curve without a miss finite.
    """
    x = np.log(size) - np.log(size).mean()
    columns, p = np.stack((np.ones_like(x), x), axis=1), np.zeros(2)
    for _ in range(STEPS):
        chance = 1.0 / (1.0 + np.exp(-columns @ p))
        slope = columns.T @ (named - chance) - RIDGE * p
        p = p + np.linalg.solve((columns.T * (chance * (1.0 - chance))) @ columns + RIDGE * np.eye(2), slope)
    if p[1] <= 0.0:
        share = (named.sum() + RIDGE) / (len(named) + 2.0 * RIDGE)
        return math.log(share / (1.0 - share)), 0.0
    return float(p[0] - p[1] * np.log(size).mean()), float(p[1])


def at_share(curve: tuple[float, float], probability: float) -> float:
    """Size at which a curve reaches a probability."""
    a, b = curve
    missing = math.log(probability / (1.0 - probability)) - a
    if b < 1e-9:
        return math.inf if missing > 0.0 else 0.0
    return math.exp(min(missing / b, 700.0))


def rho90(size: np.ndarray, named: np.ndarray, rng: np.random.Generator) -> tuple[float, float, float]:
    """Size that is named with 90 % probability, with its 95 % bootstrap interval."""
    draws = []
    for _ in range(DRAWS):
        i = rng.integers(len(size), size=len(size))
        draws.append(at_share(logistic(size[i], named[i]), 0.9))
    low, high = np.quantile(np.minimum(draws, 1e9), [0.025, 0.975])
    return at_share(logistic(size, named), 0.9), float(low), float(high)


def within(value: float, size: np.ndarray, scale: float = 1.0, digits: int = 2) -> str:
    """A size as text, times ``scale``; what lies outside the sizes that were flown is told as that alone."""
    least, most = size.min(), size.max()
    sign = "<" if value < least else ">" if value > most else ""
    return f"{sign}{float(np.clip(value, least, most)) * scale:.{digits}g}"


def truth_of(world: dict) -> set[str]:
    """Hidden effects that have a name."""
    return {n for n in world["recipe"]["effects"] if not n.startswith("law_")}


def names(world: dict) -> tuple[int, int, int, int]:
    """Names given, right up to class, right and alone, and hidden effects that were found."""
    truth, hits, exact, right = truth_of(world), set(), 0, 0
    groups = [set(g) for g in world.get("named", ())]
    for group in groups:
        new = near(group, truth) - hits
        if new:
            right += 1
            exact += int(bool(group & truth) and len(group) == 1)
            hits |= new
    return len(groups), right, exact, len(hits)


def accuracy(worlds: Sequence[dict]) -> list[str]:
    """Table of the kinds of worlds."""
    lines = [
        "| kind | worlds | failed | not waited for | hidden found | names right up to class | names exact | more names than causes "
        "| NO EFFECT | KNOWN | UNKNOWN | inconsistent | s, median (worst) |",
        "|---|---:|---:|---:|---|---|---|---|---:|---:|---:|---:|---:|",
    ]  # fmt: skip
    for kind, begun in grouped(worlds, lambda w: w["kind"]).items():
        group = answered(begun)
        told = [w for w in group if "error" not in w]
        counts = np.array([names(w) for w in group]).reshape(-1, 4)
        given, right, exact, found = map(int, counts.sum(0))
        hidden = sum(len(truth_of(w)) for w in group)
        more = sum(int(c[0] > len(truth_of(w))) for c, w in zip(counts, group))
        overall = [sum(w["overall"].startswith(x) for w in told) for x in ("NO EFFECT", "KNOWN", "UNKNOWN", "DATA")]
        seconds = f"{np.median([w['explain_s'] for w in told]):.0f} ({max(w['explain_s'] for w in told):.0f})" if told else "-"
        row = [kind, len(group), len(group) - len(told), len(begun) - len(group)]
        row += [share(found, hidden), share(right, given), share(exact, given)]
        row += [share(more, len(group)), *overall, seconds]
        lines.append("| " + " | ".join(map(str, row)) + " |")
    return lines


def answered(worlds: Sequence[dict]) -> list[dict]:
    """Worlds whose verdict was waited for."""
    return [w for w in worlds if w.get("error") != NOT_WAITED]


def grouped(items: Iterable[dict], key: Callable[[dict], str]) -> dict[str, list[dict]]:
    """Items by key, keys sorted."""
    out = defaultdict(list)
    for item in items:
        out[key(item)].append(item)
    return dict(sorted(out.items()))


def singles(worlds: Sequence[dict]) -> dict[str, tuple[np.ndarray, np.ndarray]]:
    """Effect -> sizes in floors and whether they were named (up to class), of worlds with one hidden effect."""
    out: dict[str, list] = defaultdict(list)
    for w in worlds:
        effects = w["recipe"]["effects"]
        if len(effects) == 1 and truth_of(w):
            (name, theta), = effects.items()
            out[name].append((abs(theta) / FLOORS[name], names(w)[3] == 1))
    return {n: (np.array([s for s, _ in v]), np.array([k for _, k in v])) for n, v in sorted(out.items())}


def completeness(worlds: Sequence[dict]) -> list[str]:
    """Table of the sizes named with 90 % probability, the effects that are asked for first."""
    rng, curves = np.random.default_rng(0), singles(worlds)
    lines = ["| effect | worlds | sizes [floors] | named | rho90 [floors] | rho90 | asked for |", "|---|---:|---|---|---|---|---|"]
    if not curves:
        return []
    whole = tuple(np.concatenate([v[i] for v in curves.values()]) for i in range(2))
    for name in ["all", *sorted(curves, key=lambda n: (n not in LIMITS, n))]:
        size, named = whole if name == "all" else curves[name]
        row = [name, len(size), f"{size.min():.1f} to {size.max():.1f}", share(int(named.sum()), len(size))]
        limit, factor, unit = LIMITS.get(name, (math.nan, 1.0, ""))
        if len(size) >= FEWEST:
            found = rho90(size, named, rng)
            row.append("{} [{}, {}]".format(*(within(x, size) for x in found)))
            row.append(f"{within(found[0], size, FLOORS[name] * factor)} {unit}" if name in LIMITS else "-")
        else:
            row += ["-", "-"]
        row += [f"{limit * factor:.2g} {unit}" if limit == limit else "-"]
        lines.append("| " + " | ".join(map(str, row)) + " |")
    return lines


def intervals(worlds: Sequence[dict]) -> list[str]:
    """Coverage of the intervals and error of the estimates of the effects that were named by their own names."""
    rows = [e for w in worlds for e in w.get("errors", ()) if e.get("named", True) and e["name"] in FLOORS]
    rows = [e for e in rows if e.get("sd") or "sd" not in e]
    lines = []
    for level in LEVELS:
        if level == 95:
            inside = [e["low"] <= e["truth"] <= e["high"] for e in rows]
        else:
            z = NormalDist().inv_cdf(0.5 + level / 200.0)
            inside = [abs(e["estimate"] - e["truth"]) <= z * e["sd"] for e in rows if "sd" in e]
        lines.append(f"- {level} % intervals hold the truth: {share(sum(inside), len(inside))}")
    if rows:
        off = np.array([abs(e["estimate"] - e["truth"]) / FLOORS[e["name"]] for e in rows])
        lines.append(f"- error of the estimate: median {np.median(off):.2f} floors, nine of ten within {np.quantile(off, 0.9):.2f}")
    return lines


def gain_ratio(held: dict) -> float:
    """Share of the oracle's nats on unseen throws; NaN where the truth gains next to nothing there."""
    gained = held["before"] - held.get("oracle", math.inf)
    return (held["before"] - held["after"]) / gained if gained > MATTERS else math.nan


def gains(worlds: Sequence[dict]) -> list[str]:
    """Gain on throws that were held back, in parts of what the truth gains there, and harm."""
    lines = ["| kind | worlds | median, of the oracle's gain | worst tenth | where something was named: median, worst tenth "
             "| harm: worse than before by 3 nats | by 1 % of the error |", "|---|---:|---:|---:|---:|---|---|"]  # fmt: skip
    with_held = [w for w in worlds if "samples" in w.get("held", {})]
    for kind, group in {**grouped(with_held, lambda w: w["kind"]), "all": with_held}.items():
        ratio = [(gain_ratio(w["held"]), bool(w["named"])) for w in group]
        every = [r for r, _ in ratio if math.isfinite(r)]
        named = [r for r, told in ratio if told and math.isfinite(r)]
        worse = [(h["after"] - h["before"], h["samples"]) for h in (w["held"] for w in group) if h["after"] != h["before"]]
        row = [kind, len(group), *(f"{np.quantile(every, q):.2f}" if every else "-" for q in (0.5, 0.1))]
        row += [f"{np.median(named):.2f}, {np.quantile(named, 0.1):.2f}" if named else "-"]
        row += [share(sum(nats > HARM_NATS for nats, _ in worse), len(worse))]
        row += [share(sum(2.0 * nats / samples > HARM**2 - 1.0 for nats, samples in worse), len(worse))]
        lines.append("| " + " | ".join(map(str, row)) + " |")
    return lines


def laws(worlds: Sequence[dict]) -> list[str]:
    """What became of laws outside the catalogue."""
    hidden = [(w, next(iter(w["recipe"]["effects"]))) for w in worlds if w["kind"] == "law"]
    if not hidden:
        return []
    ranks = [w["laws"].index(TERMS[law]) + 1 if TERMS[law] in w.get("laws", ()) else None for w, law in hidden]
    n = len(hidden)
    return [
        f"- UNKNOWN: {share(sum(w.get('unknown', False) for w, _ in hidden), n)}",
        f"- a wrong name besides: {share(sum(bool(w.get('named')) for w, _ in hidden), n)}",
        f"- the true term is the best formula: {share(ranks.count(1), n)}; among the best three: {share(n - ranks.count(None), n)}",
    ]


def draw(worlds: Sequence[dict], path: Path) -> None:
    """Completeness by size: counts in bins with intervals, the logistic curve of all, and those of the effects asked for."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    curves = singles(worlds)
    size, named = (np.concatenate([v[i] for v in curves.values()]) for i in range(2))
    figure, axes = plt.subplots(1, 2, figsize=(11, 4.2), sharex=True, sharey=True, layout="constrained")
    edges = np.exp(np.linspace(np.log(0.98 * size.min()), np.log(1.02 * size.max()), 9))
    grid = np.geomspace(edges[0], edges[-1], 200)
    for low, high in pairwise(edges):
        here = named[(size >= low) & (size < high)]
        if len(here):
            value, least, most = wilson(int(here.sum()), len(here))
            centre = math.sqrt(low * high)
            axes[0].errorbar(centre, value, [[max(value - least, 0.0)], [max(most - value, 0.0)]], fmt="o", color="C0", capsize=3)
            axes[0].annotate(f"{len(here)}", (centre, 0.02), ha="center", fontsize=8, color="grey")
    drawn = {"all effects": logistic(size, named)}
    axes[0].plot(grid, _chance(grid, drawn["all effects"]), color="C0", label="all effects")
    for i, name in enumerate(n for n in LIMITS if n in curves and len(curves[n][0]) >= FEWEST):
        axes[1].plot(grid, _chance(grid, logistic(*curves[name])), color=f"C{i}", label=f"{name} ({len(curves[name][0])})")
        axes[1].plot(curves[name][0], curves[name][1] + 0.008 * (i - 4), ".", color=f"C{i}", alpha=0.6)
    for axis, title in zip(axes, ("all effects; worlds in grey, bars 95 %", "effects whose limits are asked for (worlds)")):
        axis.axhline(0.9, color="grey", linewidth=0.8, linestyle=":")
        axis.set(xscale="log", xlabel="hidden size [floors]", ylim=(-0.05, 1.06), title=title)
        axis.set_xticks([3, 5, 10, 20, 30], ["3", "5", "10", "20", "30"])
        axis.minorticks_off()
    axes[0].set_ylabel("share that was named")
    if axes[1].lines[1:]:
        axes[1].legend(fontsize=8, loc="center right")
    figure.savefig(path, dpi=130)
    plt.close(figure)


def _chance(size: np.ndarray, curve: tuple[float, float]) -> np.ndarray:
    return 1.0 / (1.0 + np.exp(-(curve[0] + curve[1] * np.log(size))))


def summary(worlds: Sequence[dict]) -> str:
    """All tables as Markdown."""
    told = answered(worlds)
    parts = {
        "What was named": accuracy(worlds), "By plant": plants(told), "Completeness": completeness(told),
        "Intervals": intervals(told), "Gain on throws that were held back": gains(told), "Laws outside the catalogue": laws(told),
        "What went wrong": failures(told),
    }  # fmt: skip
    return "\n".join(f"## {title}\n\n" + "\n".join(lines) + "\n" for title, lines in parts.items() if lines)


def plants(worlds: Sequence[dict]) -> list[str]:
    """Nulls with a name and singles found, by plant."""
    lines = ["| plant | nulls with a name | one effect: found | names wrong |", "|---|---|---|---|"]
    for plant, group in grouped(worlds, lambda w: w["recipe"]["plant"]).items():
        nulls = [w for w in group if not w["recipe"]["effects"]]
        one = [w for w in group if len(truth_of(w)) == 1]
        given, right = np.array([names(w)[:2] for w in group]).sum(0)
        row = [plant, share(sum(bool(w.get("named")) for w in nulls), len(nulls)), share(sum(names(w)[3] for w in one), len(one))]
        lines.append("| " + " | ".join([*row, share(int(given - right), int(given))]) + " |")
    return lines


def failures(worlds: Sequence[dict]) -> list[str]:
    """Worlds with a wrong name or without an answer, one a line."""
    lines = []
    for w in sorted(worlds, key=lambda w: (w["kind"], w["recipe"]["plant"])):
        given, right = names(w)[:2]
        if given > right or "error" in w:
            hidden = ", ".join(f"{n} {t:+.3g}" for n, t in w["recipe"]["effects"].items()) or "nothing"
            named = "; ".join(" or ".join(g) for g in w.get("named", ())) or w.get("error", "").strip().splitlines()[-1][:90]
            lines.append(f"- {w['kind']}, {w['recipe']['plant']}, seed {w['recipe']['seed']}: {hidden} -> {named}")
    return lines


def read(paths: Sequence[Path]) -> list[dict]:
    """Worlds of ledgers, each once."""
    lines = [json.loads(line) for path in paths for line in path.read_text().splitlines()]
    return list({line["truth_sha256"]: line for line in lines}.values())


def main() -> None:
    """Print what ledgers say as Markdown, and draw it."""
    parser = argparse.ArgumentParser(description=main.__doc__)
    parser.add_argument("ledgers", nargs="+", type=Path)
    parser.add_argument("--out", type=Path, help="folder for completeness.png")
    args = parser.parse_args()
    worlds = read(args.ledgers)
    print(summary(worlds))
    if args.out and singles(answered(worlds)):
        args.out.mkdir(parents=True, exist_ok=True)
        draw(answered(worlds), args.out / "completeness.png")


if __name__ == "__main__":
    main()
