"""Proposal of a mapping of a foreign table's columns, by their names, their values and physics.

Names group columns and hint at their quantities. Values determine units: a quaternion has length 1,
a resting accelerometer shows 9.81 m/s^2 or 1 g. Physics decides: a velocity is the derivative of a
position, rates are those of the attitude, a payload keeps its distance. Whatever remains uncertain
becomes a question."""

import re
from collections import defaultdict
from dataclasses import dataclass, field, replace

import numpy as np
from numpy import ndarray

from visthrow.common.errors import LogError
from visthrow.diagnose.inputs.columns import NAMES, PATTERNS, groups_of, moves, rises, unit_by_name
from visthrow.diagnose.inputs.recognition import Recognition
from visthrow.diagnose.inputs.unit_evidence import LIGHTEST, THRUSTS, find_unit_by_mass
from visthrow.logs.check import physics, thrust_checks
from visthrow.logs.check.rows import KnownVehicle
from visthrow.logs.flightlog import FlightLog
from visthrow.logs.mapping import TableMap, TimeColumn
from visthrow.logs.readers.table_to_log import Table, logs_of
from visthrow.logs.unit_names import UNITS, fitting_units

# rotor drag over mass [1/s] (Faessler et al. 2018); without drag, wind would be found as a tilt
_DRAG = 0.3
_TIMES = ("s", "ms", "us", "ns")
_STEP = (2e-4, 0.25)  # range of the time between two rows of a log [s]


@dataclass
class MappingProposal:
    """A proposed mapping, with reasons and open questions."""

    mapping: TableMap | None = None
    # proposed parameters of the flying model; None if the log holds too little for one
    flyer: dict | None = None
    why: dict[str, str] = field(default_factory=dict)  # channel -> reason
    questions: list[str] = field(default_factory=list)
    left_out: list[str] = field(default_factory=list)  # unused columns and parts of the source


def propose(
    table: Table, source: str, mass: float | None = None, time_unit: str | None = None
) -> MappingProposal:
    """Propose a mapping of the columns of a table, or of the tables of a recording.

    ``source``: name for messages; ``mass``: of the vehicle alone [kg], if it was weighed;
    ``time_unit``: of the stamps, if known. Raises LogError: no column holds numbers that change.
    """
    numbers = {
        name: np.where(np.isfinite(cells.astype(float)), cells, np.nan)
        for name, cells in table.items()
        if cells.dtype.kind in "fiub"
    }
    if not any(moves(cells[:, None]) for cells in numbers.values()):
        raise LogError(f"{source}: none of its {len(table)} columns holds numbers that change")
    proposal = MappingProposal()
    proposal.mapping = _map_columns(numbers, proposal, getattr(table, "settings", {}), time_unit)
    mapped = proposal.mapping.columns if proposal.mapping is not None else set()
    proposal.left_out = [name for name in table if name not in mapped]
    proposal.left_out += getattr(table, "left_out", [])
    if proposal.mapping is None:
        proposal.questions.append(
            "no column looks like a position, an attitude, rates, forces or motors: which columns"
            " are they?"
        )
        return proposal
    log = _correct(table, source, proposal)
    corrected = proposal.mapping
    _judge_thrust(log, proposal, mass)
    if proposal.mapping is not corrected:
        log = _without_sparse(logs_of(table, proposal.mapping, source)[0])
    proposal.flyer = _flyer(log, proposal, mass)
    if mass is not None and proposal.flyer is None:
        proposal.questions.append(
            "--mass is not used: a flying model needs a thrust or motors, an attitude and a"
            " position; not all are found"
        )
    return proposal


def propose_model(log: FlightLog, mass: float | None = None) -> MappingProposal:
    """Propose a flying model, without a mapping, for a log that needs none.

    ``mass``: of the vehicle alone [kg], if it was weighed.
    Raises LogError: the log holds too little for a flying model.
    """
    proposal = MappingProposal()
    full = _without_sparse(log)
    proposal.flyer = _flyer(full, proposal, mass)
    if proposal.flyer is None:
        raise LogError(
            f"{log.meta.get('source')}: no flying model proposed: that needs pos_w, quat_wb and one"
            f" of {', '.join(thrust_checks.INPUTS)}; of those that hold 50 samples it has"
            f" {', '.join(full.channels)}"
        )
    return proposal


def _map_columns(
    numbers: Table, proposal: MappingProposal, settings: dict[str, str], time_unit: str | None
) -> TableMap | None:
    """Map columns of numbers, and add reasons and questions to the proposal; None without a
    channel.
    """
    channels = {}
    clocks = {}
    unread = []  # questions about tables without a channel
    for topic, part in _tables(numbers).items():
        if len(next(iter(part.values()))) < 50:
            continue
        asked = len(proposal.questions)
        clock, time = _clock(part, proposal, time_unit)
        columns = {
            name: cells
            for name, cells in part.items()
            if name != clock.column and len(cells) == len(time)
        }
        recognition = Recognition(time, groups_of(columns), settings)
        rivals = []
        for recognised in recognition.channels():
            entry = recognised.entry
            if entry.name in channels:
                listed = ", ".join(entry.columns)
                rivals.append(f"'{entry.name}' is also {listed}: which one?")
                continue
            clocks[topic] = clock
            first = topic == next(iter(clocks))
            channels[entry.name] = replace(entry, clock="" if first else topic)
            proposal.why[entry.name] = recognised.why
        proposal.questions += recognition.questions
        if topic not in clocks:  # this table has no channel
            unread += proposal.questions[asked:]
            del proposal.questions[asked:]
        proposal.questions += rivals
    if not channels:
        proposal.questions += unread
        return None
    main, *further = clocks
    others = {name: clocks[name] for name in further} or None
    return TableMap(clocks[main], tuple(channels.values()), others)


def _tables(numbers: Table) -> dict[str, Table]:
    """Group columns by their table, whose name precedes a colon."""
    tables = defaultdict(dict)
    for name, cells in numbers.items():
        tables[name.rpartition(":")[0]][name] = cells
    return tables


def _clock(
    numbers: Table, proposal: MappingProposal, stated_unit: str | None
) -> tuple[TimeColumn, ndarray]:
    """Return the mapping of the stamps and their times [s]; without a clock, evenly spaced rows."""
    rising = [name for name, cells in numbers.items() if rises(cells)]
    named = [name for name in rising if PATTERNS["time"].search(name)]
    named.sort(key=lambda name: "frame" in name.lower())  # frame counters only without a time
    name = next(iter(named or rising), None)
    if name is None:
        count = max(map(len, numbers.values()))
        proposal.questions.append(
            "no column rises like a clock: how far are the rows apart? row_period = 0.01 [s] is a"
            " guess"
        )
        return TimeColumn(row_period=0.01), 0.01 * np.arange(count)
    steps = np.diff(numbers[name])
    step = float(np.median(steps[steps > 0.0]))  # several rows may have the same stamp
    rate = re.search(r"(\d+) ?hz", name, re.IGNORECASE)
    suffix = f"1/{rate[1]} s" if rate else ""
    if suffix not in UNITS:
        suffix = stated_unit or unit_by_name(name)
    fitting = fitting_units(step, _TIMES, *_STEP)
    denied = fitting and suffix in _TIMES and suffix not in fitting and not stated_unit
    known = UNITS.get(suffix, ("",))[0] == "s" and not denied
    unit = suffix if known else next(iter(fitting), "s")
    if denied or (not suffix and len(fitting) != 1):
        proposal.questions.append(
            f"time '{name}': a step of {step:g} fits the units {', '.join(fitting) or 'of none'};"
            f" '{unit}' is a guess"
        )
    if not named:
        proposal.questions.append(f"is '{name}', the first column that rises, the time?")
    seconds = UNITS[unit][1]
    proposal.why["time"] = f"rises by {step:g} a row, {1.0 / (step * seconds):.4g} Hz"
    return TimeColumn(name, unit), numbers[name] * seconds


def _correct(table: Table, source: str, proposal: MappingProposal) -> FlightLog:
    """Read the table by the proposal and check it against physics.

    Axes of rates are corrected if others explain them; other contradictions become questions.
    Returns the log without sparse channels.
    """
    for attempt in range(2):
        log = _without_sparse(logs_of(table, proposal.mapping, source)[0])
        wrong = [row for row in physics.look(log) if row.verdict == "bad"]
        turns = [
            row
            for row in wrong
            if row.topic == "frames" and "axes" in row.figures and row.channel.endswith("rate_b")
        ]
        if attempt or not turns or "a mirror image" in turns[0].text:
            break
        turned = replace(proposal.mapping.entry("rate_b"), axes=turns[0].figures["axes"])
        proposal.mapping = proposal.mapping.with_entry(turned)
        proposal.why["rate_b"] += f"; axes by physics: {turns[0].text}"
    proposal.questions += [f"{row.channel} contradicts physics: {row.text}" for row in wrong]
    return log


def _without_sparse(log: FlightLog) -> FlightLog:
    """Return a log without channels of fewer than 50 valid samples."""
    full = {name: c for name, c in log.channels.items() if c.valid.sum() >= 50}
    return FlightLog(full, log.meta)


def _judge_thrust(log: FlightLog, proposal: MappingProposal, weighed: float | None) -> None:
    """Check the thrust's unit against the mass, and ask what remains open.

    Raises LogError: the weighed mass fits the thrust in grams, but not in kilograms.
    """
    entry = proposal.mapping.entry("thrust_command")
    carried = thrust_checks.mass_of(log)
    heavy = weighed is not None and weighed >= 1e3 * LIGHTEST  # perhaps grams
    if entry is None or carried is None:
        if heavy:
            proposal.questions.append(
                f"the vehicle weighs {weighed:g} kg? Nothing in the log is in newtons, to compare;"
                f" for grams write {weighed / 1e3:g}"
            )
        return
    thrust = f"thrust '{entry.columns[0]}'"
    named = unit_by_name(entry.columns[0]) == entry.unit
    units = (entry.unit,) if named else THRUSTS
    one = carried / UNITS[entry.unit][1]  # if the column were in newtons
    masses = {unit: one * UNITS[unit][1] for unit in units}
    if weighed is None:
        if not named:
            listed = ", ".join(f"{mass:.3g} kg in {unit}" for unit, mass in masses.items())
            proposal.questions.append(
                f"{thrust}: in newtons for all motors together, as assumed? It carries {listed}"
            )
        return
    unit = find_unit_by_mass(one, weighed, units)
    in_grams = find_unit_by_mass(one, 1e-3 * weighed, units) if heavy else ""
    if in_grams and not unit:
        raise LogError(
            f"--mass {weighed:g} is {weighed:g} kg, but the {thrust} carries"
            f" {masses[in_grams]:.3g} kg in {in_grams}: grams? Expected kilograms: --mass"
            f" {weighed / 1e3:g}"
        )
    if not unit:
        proposal.questions.append(
            f"{thrust} carries {carried:.3g} kg in {entry.unit}, and the vehicle weighs"
            f" {weighed:g} kg: no unit explains that; is it of one motor, of another vehicle, or a"
            " share of the full thrust?"
        )
        return
    proposal.why[entry.name] += f"; {unit} by the mass: it carries {masses[unit]:.4g} kg"
    if unit != entry.unit:
        proposal.mapping = proposal.mapping.with_entry(replace(entry, unit=unit))
    if doubt := _doubt_of_mass(np.log(masses[unit] / weighed), "payload_pos_w" in log):
        proposal.questions.append(
            f"{thrust} carries {masses[unit]:.4g} kg in {unit}, and the vehicle weighs {weighed:g}"
            f" kg: {doubt}"
        )
    if in_grams:
        proposal.questions.append(
            f"the vehicle weighs {weighed:g} kg and '{entry.columns[0]}' is in {unit}, or"
            f" {weighed:g} g and {in_grams}?"
        )


def _doubt_of_mass(off: float, hangs: bool) -> str:
    """Return a question about a thrust that carries another mass than the vehicle's; "" for a
    difference that the battery's charge explains.

    ``off``: log ratio of carried mass to the vehicle's; ``hangs``: whether a payload is mapped."""
    if off < -thrust_checks.MASS_WARN:
        return "of another battery, or a share of the full thrust?"
    if off > thrust_checks.MASS_WARN and not hangs:
        return (
            "does a load hang below? The model has none; map its position as payload_pos_w and add"
            " [flyer.cable]"
        )
    return ""


def _find_input(log: FlightLog, proposal: MappingProposal) -> str:
    """Return the input that the force follows best, or "" if that cannot be determined."""
    inputs = [name for name in thrust_checks.INPUTS if name in log]
    scores = {name: s for name in inputs if (s := thrust_checks.follows(log, name)) is not None}
    if len(inputs) < 2:
        return ""
    question = f"which of {', '.join(inputs)} drives the vehicle?"
    if not scores:
        proposal.questions.append(f"{question} The force does not tell; '{inputs[0]}' is assumed")
        return ""
    best = max(scores, key=scores.__getitem__)
    listed = ", ".join(f"{name} {score:.2f}" for name, score in scores.items())
    proposal.questions.append(
        f"{question} The force follows '{best}' best (correlations: {listed})"
    )
    return best


def _flyer(log: FlightLog, proposal: MappingProposal, weighed: float | None) -> dict | None:
    """Return parameters of a flying model: the thrust is scaled to carry the vehicle, others are
    those of a small quadrotor.
    """
    vehicle = KnownVehicle(thrust_input=_find_input(log, proposal))
    applied = thrust_checks.thrust_of(log, vehicle)
    carried = thrust_checks.thrust_over_force(log, vehicle)
    if applied is None or carried is None or not {"quat_wb", "pos_w"} <= log.channels.keys():
        return None
    name = applied[0]
    mass = thrust_checks.mass_of(log)
    path = log["pos_w"].samples()
    length = 0.0
    if "payload_pos_w" in log:
        payload = log["payload_pos_w"].samples()
        gap = payload.values - path.at(payload.time)
        length = float(np.median(np.linalg.norm(gap, axis=1)))
    share = 0.85 if length else 1.0  # mass of the vehicle over the total, until both are weighed
    whole = weighed / share if weighed else mass or 1.0
    hanging = (1.0 - share) * whole
    if weighed is None:
        why = "is a placeholder, to which the thrust is scaled"
        why = "is what its thrust carries" if mass else why
        proposal.questions.append(
            f"what does the vehicle weigh? {whole:.4g} kg {why}; call map again with --mass KG"
        )
    if length:
        proposal.questions.append(f"what does the payload weigh? {hanging:.3g} kg is a guess")
    newtons = mass is not None and name in ("command", "thrust_command")
    first = whole / carried[0]
    if newtons and abs(np.log(first)) < thrust_checks.MASS_BAD:
        first = 1.0
    measured = name == "motor_speed"  # measured behind the motors' lag
    power = [0.0, 0.0, first] if measured else [0.0, first, 0.0]
    if name in thrust_checks.PULSES and thrust_checks.are_pulses(log[name].values):
        power[0] = -first * thrust_checks.IDLE_PULSE
    volts = log["battery_voltage"].values if "battery_voltage" in log else [1.0]
    flyer = {
        "input": name,
        "position": "pos_w",
        "attitude": "quat_wb",
        "mass": round(whole * share, 5),
        "thrust_map": [float(f"{x:.4g}") for x in power],
        "reference_voltage": float(np.round(np.median(volts), 2)),
        "every": max(1, round(0.03 / float(np.median(np.diff(path.time))))),
        "drag_xy": float(f"{_DRAG * whole * share:.2g}"),
        **NAMES["flyer"],
    }
    if measured:
        flyer["motor_time_constant"] = 0.0
    if length:
        flyer["cable"] = {"length": round(length, 4), "mass": round(hanging, 5)}
    return flyer
