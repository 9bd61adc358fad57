"""Tables of sealed worlds' ledgers: accuracy, completeness, coverage, gain against the oracle; with
intervals.

    python -m bench.diagnose.ledger ledger.jsonl [more.jsonl] --out FOLDER     # prints Markdown,
    draws completeness.png

A world in which the tool failed counts as one in which nothing was named. One whose verdict was cut
off by the bank's time limit counts in no column but its own.

Of the 1,924 seeds of the shipped ledger's banks, 13 have no line, for unknown reasons: 11 belong to
the bank of b5d7a9d, among these five of its 15 laws (seeds 89700501 and on). 23 lines are worlds
that ran out of time, nine of them laws."""

import argparse
import json
import math
from collections import Counter, defaultdict
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from statistics import NormalDist

import numpy as np

from bench.diagnose.sealed import NOT_WAITED, TERMS, match_names
from bench.worlds.world import ALL_FLOORS, CAMERA_FLOORS

DRAG = 0.51 / 1.04e-3
"""Drag coefficient of a payload over its drag k = rho C_d A / 2 [m/kg]: a tennis ball has 1.04e-3
kg/m.
"""
LIMITS = {
    "rope_length": (3e-3, 1e3, "mm"),
    "cmd_delay": (4e-3, 1e3, "ms"),
    "motor_tau": (4e-3, 1e3, "ms"),
    "release_lag": (8e-3, 1e3, "ms"),
    "payload_drag": (0.3 / DRAG, DRAG, "of C_d"),
    "wind_x": (0.15, 1.0, "m/s"),
    "com_x": (5e-4, 1e3, "mm"),
    "marker_rot_x": (math.radians(0.2), math.degrees(1.0), "deg"),
    "frame_tilt_x": (math.radians(0.2), math.degrees(1.0), "deg"),
    "thrust_gain": (0.01, 100.0, "%"),
    "camera_tilt_x": (math.radians(0.2), math.degrees(1.0), "deg"),
    "camera_latency": (1e-3, 1e3, "ms"),
}
"""Effect -> required detection limit (SI), factor and unit to print."""

RANDOM = {"release_lag": "lag_jitter", "cmd_delay": "cmd_jitter", "wind_x": "gust"}
"""Random effects of the catalogue: effect -> its name where it differs from flight to flight."""
LEVELS = (50, 80, 95)
MATTERS = 5.0
"""Nats that the truth must gain on held-out throws for a gain to be counted."""
HARM = 1.01
HARM_NATS = 3.0
"""Increase of the error on held-out throws, per sample in its deviations, and decrease of their log
likelihood, that count as harm.
"""
NINE = math.log(9.0)
DECADE = math.log(10.0)
WIDTHS = (0.05, 3.0)  # from 50 to 90 % in log size: the prior's range
GRID = 160  # points of the grid of curves
FEWEST = 6  # least worlds of an effect for a separate curve
BINNED = 30  # worlds of an effect for counts in bins
WITH_CAMERA = ", camera"


def wilson(k: int, n: int, level: float = 0.95) -> tuple[float, float, float]:
    """Share k / n with Wilson's interval (Wilson 1927)."""
    if n == 0:
        return math.nan, math.nan, math.nan
    z = NormalDist().inv_cdf(0.5 + 0.5 * level)
    centre = (k + 0.5 * z * z) / (n + z * z)
    half = z / (n + z * z) * math.sqrt(k * (n - k) / n + 0.25 * z * z)
    return k / n, max(centre - half, 0.0), min(centre + half, 1.0)


def share(k: int, n: int) -> str:
    """``12/14 = 86 % [60, 96]``."""
    if not n:
        return "-"
    value, low, high = wilson(k, n)
    return f"{k}/{n} = {100 * value:.0f} % [{100 * low:.0f}, {100 * high:.0f}]"


@dataclass(frozen=True)
class Curve:
    """Posterior of ``log odds of being named = a + b log size``: points of a grid and their
    probabilities.
    """

    half: np.ndarray  # log of the size that is named with 50 % probability
    width: np.ndarray  # from there to 90 %, in log size
    weight: np.ndarray

    def size(self, probability: float) -> tuple[float, float, float]:
        """Median and 95 % interval of the size that is named with a probability."""
        at = self.half + self.width * math.log(probability / (1.0 - probability)) / NINE
        order = np.argsort(at)
        below = np.cumsum(self.weight[order])
        return tuple(
            float(np.exp(at[order][min(np.searchsorted(below, q), len(at) - 1)]))
            for q in (0.5, 0.025, 0.975)
        )

    def chance(self, size: np.ndarray) -> np.ndarray:
        """Mean, and ends of the 95 % interval, of the share that is named, shape (3, N)."""
        p = 1.0 / (1.0 + np.exp(-NINE * (np.log(size)[:, None] - self.half) / self.width))
        order = np.argsort(p, axis=1)
        below = np.cumsum(self.weight[order], axis=1)
        ends = [
            np.take_along_axis(
                p,
                np.take_along_axis(order, (below < q).sum(1)[:, None].clip(max=p.shape[1] - 1), 1),
                1,
            )[:, 0]
            for q in (0.025, 0.975)
        ]
        return np.stack((p @ self.weight, *ends))


def curve(size: np.ndarray, named: np.ndarray) -> Curve:
    """Logistic curve of completeness over log size.

    The prior is flat in the logarithms of the 50 % size (a decade beyond what was flown, either
    way) and of the width: sizes that were all named, or none, leave a wide interval instead of a
    curve without an error."""
    ends = np.log(size.min()) - DECADE, np.log(size.max()) + DECADE
    half, width = (
        x.ravel() for x in np.meshgrid(np.linspace(*ends, GRID), np.geomspace(*WIDTHS, GRID // 4))
    )
    odds = NINE * (np.log(size)[:, None] - half) / width
    likely = -np.logaddexp(0.0, np.where(named[:, None], -odds, odds)).sum(0)
    weight = np.exp(likely - likely.max())
    return Curve(half, width, weight / weight.sum())


def format_interval(
    interval: tuple[float, float, float], size: np.ndarray, scale: float = 1.0
) -> str:
    """A size and its interval as text, times ``scale``; values outside the flown sizes appear as a
    bound.
    """
    least = size.min()
    most = size.max()
    texts = []
    for x in interval:
        sign = "<" if x < least else ">" if x > most else ""
        texts.append(f"{sign}{float(np.clip(x, least, most)) * scale:.2g}")
    return "{} [{}, {}]".format(*texts)


def judge_limit(interval: tuple[float, float, float], limit: float) -> str:
    """Whether a size and its interval lie below a limit."""
    if math.isnan(limit):
        return "-"
    return "yes" if interval[2] <= limit else "no" if interval[1] > limit else "not resolved"


def truth_of(world: dict) -> set[str]:
    """Hidden effects that have a name."""
    return {n for n in world["recipe"]["effects"] if not n.startswith("law_")}


def names(world: dict) -> tuple[int, int, int, int]:
    """Names given, right up to class, right and alone, and hidden effects that were found."""
    truth = truth_of(world)
    groups = [set(g) for g in world.get("named", ())]
    stands_for = match_names(groups, truth)
    right = sum(map(bool, stands_for))
    return (
        len(groups),
        right,
        sum(group == {name} for group, name in zip(groups, stands_for)),
        right,
    )


def accuracy(worlds: Sequence[dict]) -> list[str]:
    """Table of the kinds of worlds."""
    lines = [
        (
            "| kind | worlds | failed | not waited for | hidden found | names right up to class |"
            " names exact | more names than causes | NO EFFECT | KNOWN | UNKNOWN | inconsistent |"
            " s, median (worst) |"
        ),
        "|---|---:|---:|---:|---|---|---|---|---:|---:|---:|---:|---:|",
    ]
    for kind, begun in group_by_key(worlds, lambda w: w["kind"]).items():
        group = select_answered(begun)
        finished = [w for w in group if "error" not in w]
        counts = np.array([names(w) for w in group]).reshape(-1, 4)
        given, right, exact, hits = map(int, counts.sum(0))
        hidden = sum(len(truth_of(w)) for w in group)
        more = sum(int(c[0] > len(truth_of(w))) for c, w in zip(counts, group))
        overall = [
            sum(w["overall"].startswith(x) for w in finished)
            for x in ("NO EFFECT", "KNOWN", "UNKNOWN", "DATA")
        ]
        seconds = (
            f"{np.median([w['explain_s'] for w in finished]):.0f}"
            f" ({max(w['explain_s'] for w in finished):.0f})"
            if finished
            else "-"
        )
        row = [kind, len(group), len(group) - len(finished), len(begun) - len(group)]
        row += [share(hits, hidden), share(right, given), share(exact, given)]
        row += [share(more, len(group)), *overall, seconds]
        lines.append("| " + " | ".join(map(str, row)) + " |")
    return lines


def dusty(world: dict) -> bool:
    """Whether a world has a little of every effect."""
    return bool(world["recipe"].get("dust"))


def select_answered(worlds: Sequence[dict]) -> list[dict]:
    """Worlds whose verdict was not cut off."""
    return [w for w in worlds if w.get("error") != NOT_WAITED]


def group_by_key(items: Iterable[dict], key: Callable[[dict], str]) -> dict[str, list[dict]]:
    """Items by key, keys sorted."""
    out = defaultdict(list)
    for item in items:
        out[key(item)].append(item)
    return dict(sorted(out.items()))


def singles(worlds: Sequence[dict]) -> dict[str, tuple[np.ndarray, np.ndarray]]:
    """Effect -> sizes in floors and whether they were named (up to class), of worlds with one
    hidden effect.

    Effects that are not the camera's, in worlds with a camera, stand apart, as "EFFECT, camera".
    """
    out: dict[str, list] = defaultdict(list)
    for w in worlds:
        effects = w["recipe"]["effects"]
        if len(effects) == 1 and truth_of(w) and not dusty(w):
            ((name, theta),) = effects.items()
            with_camera = w["recipe"].get("camera", False) and name not in CAMERA_FLOORS
            out[name + WITH_CAMERA * with_camera].append(
                (abs(theta) / ALL_FLOORS[name], names(w)[3] == 1)
            )
    return {
        n: (np.array([s for s, _ in v]), np.array([k for _, k in v]))
        for n, v in sorted(out.items())
    }


def completeness(worlds: Sequence[dict]) -> list[str]:
    """Table of the sizes named with 50 and 90 % probability; those with a required limit first."""
    curves = singles(worlds)
    if not curves:
        return []
    head = "| effect | worlds | sizes | named | unit | 50 % | 90 % | required | kept |"
    lines = [head, "|---|---:|---|---|---|---|---|---:|---|"]
    whole = tuple(np.concatenate([v[i] for v in curves.values()]) for i in range(2))
    for name in [
        "all",
        *sorted(curves, key=lambda n: (n not in LIMITS, n)),
        *(n for n in LIMITS if n not in curves),
    ]:
        size, named = (
            whole if name == "all" else curves.get(name, (np.zeros(0), np.zeros(0, dtype=bool)))
        )
        limit, factor, unit = LIMITS.get(name, (math.nan, 1.0, "floors"))
        floor = ALL_FLOORS[name] if name in LIMITS else 1.0
        required = f"{limit * factor:.2g}" if name in LIMITS else "-"
        row = [
            name,
            len(size),
            (
                f"{size.min() * floor * factor:.2g} to {size.max() * floor * factor:.2g}"
                if len(size)
                else "-"
            ),
        ]
        row += [share(int(named.sum()), len(size)), unit]
        if len(size) >= FEWEST:
            fitted = curve(size, named)
            half = fitted.size(0.5)
            most = fitted.size(0.9)
            row += [format_interval(x, size, floor * factor) for x in (half, most)]
            row += [required, judge_limit(most, limit / floor)]
        else:
            row += ["-", "-", required, "too few worlds" if name in LIMITS else "-"]
        lines.append("| " + " | ".join(map(str, row)) + " |")
    return lines


def intervals(worlds: Sequence[dict]) -> list[str]:
    """Coverage of the intervals of correctly named effects, by the number of other effects in the
    world.
    """
    groups = {
        "nothing else": [w for w in worlds if not dusty(w)],
        "some of every other effect": [w for w in worlds if dusty(w)],
    }
    return [
        line
        for besides, group in groups.items()
        if group
        for line in [f"Besides, {besides}:", "", *coverage(group), ""]
    ]


def coverage(worlds: Sequence[dict]) -> list[str]:
    """Shares of the intervals that hold the truth, and the error of the estimates."""
    rows = [
        e
        for w in worlds
        for e in w.get("errors", ())
        if e.get("named", True) and e["name"] in ALL_FLOORS
    ]
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
        off = np.array([abs(e["estimate"] - e["truth"]) / ALL_FLOORS[e["name"]] for e in rows])
        lines.append(
            f"- error of the estimate: median {np.median(off):.2f} floors, nine of ten within"
            f" {np.quantile(off, 0.9):.2f}"
        )
    return lines


def gain_ratio(held: dict) -> float:
    """Share of the oracle's nats on held-out throws; NaN where the truth gains almost nothing."""
    gained = held["before"] - held.get("oracle", math.inf)
    return (held["before"] - held["after"]) / gained if gained > MATTERS else math.nan


def gains(worlds: Sequence[dict]) -> list[str]:
    """Gain on held-out throws as a share of the truth's gain, and harm."""
    lines = [
        (
            "| kind | worlds | median, of the oracle's gain | worst tenth | where something was"
            " named: median, worst tenth | harm: worse than before by 3 nats | by 1 % of the"
            " error |"
        ),
        "|---|---:|---:|---:|---:|---|---|",
    ]
    with_held = [w for w in worlds if "samples" in w.get("held", {})]
    for kind, group in {**group_by_key(with_held, lambda w: w["kind"]), "all": with_held}.items():
        ratio = [(gain_ratio(w["held"]), bool(w["named"])) for w in group]
        every = [r for r, _ in ratio if math.isfinite(r)]
        named = [r for r, any_named in ratio if any_named and math.isfinite(r)]
        worse = [
            (h["after"] - h["before"], h["samples"])
            for h in (w["held"] for w in group)
            if h["after"] != h["before"]
        ]
        row = [
            kind,
            len(group),
            *(f"{np.quantile(every, q):.2f}" if every else "-" for q in (0.5, 0.1)),
        ]
        row += [f"{np.median(named):.2f}, {np.quantile(named, 0.1):.2f}" if named else "-"]
        row += [share(sum(nats > HARM_NATS for nats, _ in worse), len(worse))]
        row += [
            share(sum(2.0 * nats / samples > HARM**2 - 1.0 for nats, samples in worse), len(worse))
        ]
        lines.append("| " + " | ".join(map(str, row)) + " |")
    return lines


def laws(worlds: Sequence[dict]) -> list[str]:
    """Table of the verdicts on laws outside the catalogue."""
    hidden = [(w, next(iter(w["recipe"]["effects"]))) for w in worlds if w["kind"] == "law"]
    if not hidden:
        return []
    ranks = [
        w["laws"].index(TERMS[law]) + 1 if TERMS[law] in w.get("laws", ()) else None
        for w, law in hidden
    ]
    n = len(hidden)
    return [
        f"- UNKNOWN: {share(sum(w.get('unknown', False) for w, _ in hidden), n)}",
        f"- a wrong name as well: {share(sum(bool(w.get('named')) for w, _ in hidden), n)}",
        (
            f"- the true term is the best formula: {share(ranks.count(1), n)}; among the best"
            f" three: {share(n - ranks.count(None), n)}"
        ),
    ]


def draw(worlds: Sequence[dict], path: Path) -> None:
    """Completeness by size: a panel of all effects and one of each with a required limit, with the
    curve and its 95 % band.
    """
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    curves = singles(worlds)
    whole = tuple(np.concatenate([v[i] for v in curves.values()]) for i in range(2))
    columns = 5
    figure, axes = plt.subplots(
        -(-(len(LIMITS) + 1) // columns),
        columns,
        figsize=(15, 8),
        sharey=True,
        layout="constrained",
    )
    for axis, name in zip(axes.flat, ["all effects", *LIMITS]):
        limit, factor, unit = LIMITS.get(name, (math.nan, 1.0, "floors"))
        scale = ALL_FLOORS[name] * factor if name in LIMITS else 1.0
        _panel(axis, whole if name == "all effects" else curves.get(name), limit * factor, scale)
        axis.set(ylim=(-0.06, 1.06), xlabel=f"hidden size [{unit}]", title=name)
    for axis in axes.flat[len(LIMITS) + 1 :]:
        axis.axis("off")
    for axis in axes[:, 0]:
        axis.set_ylabel("share that was named")
    figure.suptitle(
        "Share named by size: worlds (ticks), bins and logistic curve with 95 % intervals; red:"
        " size required at 90 %"
    )
    figure.savefig(path, dpi=110)
    plt.close(figure)


def _panel(axis, worlds: tuple[np.ndarray, np.ndarray] | None, limit: float, scale: float) -> None:
    from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter

    axis.axhline(0.9, color="grey", linewidth=0.8, linestyle=":")
    axis.set_xscale("log")
    if math.isfinite(limit):
        axis.axvline(limit, color="C3", linewidth=1.0)
        flown = [] if worlds is None else worlds[0] * scale
        axis.set_xlim(min([0.4 * limit, *flown]) / 1.2, max([5.0 * limit, *flown]) * 1.2)
    axis.xaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
    axis.xaxis.set_major_formatter(FuncFormatter(lambda x, _: f"{x:g}"))
    axis.xaxis.set_minor_formatter(NullFormatter())
    if worlds is not None:
        axis.plot(worlds[0] * scale, np.where(worlds[1], 1.03, -0.03), "|", color="C0", alpha=0.7)
    if worlds is None or len(worlds[0]) < FEWEST:
        label = f"{0 if worlds is None else len(worlds[0])} worlds"
        axis.text(0.5, 0.5, label, ha="center", transform=axis.transAxes, color="grey")
        return
    size, named = worlds
    grid = np.geomspace(0.9 * size.min(), 1.1 * size.max(), 100)
    mean, low, high = curve(size, named).chance(grid)
    axis.fill_between(grid * scale, low, high, color="C0", alpha=0.2, linewidth=0)
    axis.plot(grid * scale, mean, color="C0")
    if len(size) >= BINNED:
        for first, last in pairwise(np.geomspace(0.99 * size.min(), 1.01 * size.max(), 7)):
            here = named[(size >= first) & (size < last)]
            if len(here):
                value, least, most = wilson(int(here.sum()), len(here))
                spread = [[max(value - least, 0.0)], [max(most - value, 0.0)]]
                axis.errorbar(
                    math.sqrt(first * last) * scale,
                    value,
                    spread,
                    fmt="o",
                    color="black",
                    markersize=3,
                    linewidth=0.8,
                )


def summary(worlds: Sequence[dict]) -> str:
    """All tables as Markdown."""
    answers = select_answered(worlds)
    parts = {
        "What was named": accuracy(worlds),
        "By kind": kinds(answers),
        "By plant": plants(answers),
        "Completeness": completeness(answers),
        "Intervals": intervals(answers),
        "Gain on throws that were held back": gains(answers),
        "Laws outside the catalogue": laws(answers),
        "What went wrong": failures(answers),
    }
    return "\n".join(
        f"## {title}\n\n" + "\n".join(lines) + "\n" for title, lines in parts.items() if lines
    )


def right(world: dict) -> bool:
    """Whether a world's verdict is right, its overall verdict too.

    Nothing hidden: NO EFFECT. A law: UNKNOWN and no name. Lost commands, and what differs from
    flight to flight or from day to day: KNOWN for it, and no name. Effects: KNOWN, each up to
    class, and no other name."""
    recipe = world["recipe"]
    overall = world.get("overall")
    named = world.get("named")
    varies = recipe.get("varies") or {}
    varying = world.get("varies", ())
    if recipe.get("lost"):
        return overall == "KNOWN" and not named and "dropped_commands" in varying
    if recipe.get("days"):
        return (
            overall == "KNOWN"
            and not named
            and any(set(varies) & set(of) for of in world.get("drifts", ()))
        )
    if varies:
        expected = {RANDOM.get(name, f"{name}_by_flight") for name in varies}
        return overall == "KNOWN" and not named and bool(expected & set(varying))
    if any(name in TERMS for name in recipe["effects"]):
        return bool(world.get("unknown")) and not named
    return (
        bool(world.get("class")) and overall == "KNOWN"
        if recipe["effects"]
        else overall == "NO EFFECT" and not named
    )


def kinds(worlds: Sequence[dict]) -> list[str]:
    """Table of the right verdicts by kind, and of the wrong ones."""
    lines = ["| kind | right verdicts | wrong verdicts | seconds |", "|---|---|---|---|"]
    for kind, group in sorted(group_by_key(worlds, lambda w: w["kind"]).items()):
        wrong_verdicts = Counter(w.get("overall") for w in group if not right(w))
        other = ", ".join(f"{overall} {count}" for overall, count in sorted(wrong_verdicts.items()))
        seconds = np.median([w["explain_s"] for w in group])
        lines.append(
            f"| {kind} | {share(sum(map(right, group)), len(group))} | {other} | {seconds:.0f} |"
        )
    return lines


def plants(worlds: Sequence[dict]) -> list[str]:
    """Nulls with a name and singles found, by plant."""
    lines = ["| plant | nulls with a name | one effect: found | names wrong |", "|---|---|---|---|"]
    for plant, group in group_by_key(worlds, lambda w: w["recipe"]["plant"]).items():
        nulls = [w for w in group if not w["recipe"]["effects"] and not dusty(w)]
        one = [w for w in group if len(truth_of(w)) == 1 and not dusty(w)]
        given, right = np.array([names(w)[:2] for w in group]).sum(0)
        row = [
            plant,
            share(sum(bool(w.get("named")) for w in nulls), len(nulls)),
            share(sum(names(w)[3] for w in one), len(one)),
        ]
        lines.append("| " + " | ".join([*row, share(int(given - right), int(given))]) + " |")
    return lines


def failures(worlds: Sequence[dict]) -> list[str]:
    """Worlds with a wrong name or without an answer, one per line."""
    lines = []
    for w in sorted(worlds, key=lambda w: (w["kind"], w["recipe"]["plant"])):
        given, right = names(w)[:2]
        if given > right or "error" in w:
            hidden = (
                ", ".join(f"{n} {t:+.3g}" for n, t in w["recipe"]["effects"].items()) or "nothing"
            )
            named = (
                "; ".join(" or ".join(g) for g in w.get("named", ()))
                or w.get("error", "").strip().splitlines()[-1][:90]
            )
            lines.append(
                f"- {w['kind']}, {w['recipe']['plant']}, seed {w['recipe']['seed']}: {hidden} ->"
                f" {named}"
            )
    return lines


def read(paths: Sequence[Path]) -> list[dict]:
    """Worlds of ledgers, each once."""
    lines = [json.loads(line) for path in paths for line in path.read_text().splitlines()]
    return list({line["truth_sha256"]: line for line in lines}.values())


def main() -> None:
    """Print the tables of ledgers as Markdown, and draw completeness."""
    parser = argparse.ArgumentParser(description=main.__doc__)
    parser.add_argument("ledgers", nargs="+", type=Path)
    parser.add_argument("--out", type=Path, help="folder for completeness.png")
    args = parser.parse_args()
    worlds = read(args.ledgers)
    print(summary(worlds))
    if args.out and singles(select_answered(worlds)):
        args.out.mkdir(parents=True, exist_ok=True)
        draw(select_answered(worlds), args.out / "completeness.png")


if __name__ == "__main__":
    main()
