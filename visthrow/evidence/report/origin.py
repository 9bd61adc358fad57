"""Section on where the figures come from: command, commit and plant of every set of throws."""

from collections import defaultdict

from visthrow.evidence.report.result_set import ResultSet
from visthrow.evidence.report.throws import SHORT
from visthrow.view.parts import Grid, Section, Text


def section(thrown: ResultSet) -> Section:
    """A row for each command and commit that made throws, and seeds."""
    groups: dict[tuple[str, ...], list] = defaultdict(list)
    for r in thrown.results:
        made = r.provenance
        groups[(made.get("command", "-").split(" (")[0], str(made.get("commit", "-"))[:12], SHORT[r.unit["plant"]])].append(r)
    rows = []
    for (command, commit, plant), found in sorted(groups.items()):
        times = sorted(str(r.provenance.get("time", "-"))[:10] for r in found)
        seeds = ", ".join(sorted({str(r.unit["seed"]) for r in found}))
        seconds = sum(r.provenance.get("seconds", 0.0) for r in found)
        throws = sum(len(r.good) for r in found)
        rows.append((command, commit, plant, str(len(found)), str(throws), seeds, times[0] if times[0] == times[-1] else
                     f"{times[0]} to {times[-1]}", f"{seconds:.0f}"))  # fmt: skip
    parts: list = [
        Text("Seeds of throws fix starts, vehicles, winds and noise: policies and baseline meet the same ones. Intervals are "
             "percentile bootstrap intervals of 95 %; 'runs and throws' are drawn in two levels where there are several "
             "trainings. Throws that did not land have no error and count against 'landed'.")
    ]  # fmt: skip
    if rows:
        head = ("command", "commit", "plant", "sets", "throws", "seeds", "made on", "seconds of work")
        parts.append(Grid("Throws behind this page", head, tuple(rows), heads=3))
    else:
        parts.append(Text("No throws are recorded.", "missing"))
    return Section("origin", "Where the figures come from", tuple(parts))
