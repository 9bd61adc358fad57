"""Flights that cannot distinguish two causes; the tool's proposals are then flown or measured,
until one cause is named.

Kinds of :mod:`bench.diagnose.cases`: manoeuvres that ``visthrow diagnose plan`` proposes are flown
on the independent plant, proposed measurements are made there."""

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from bench.diagnose.cases import explain_logs
from bench.diagnose.sealed import flight_log, named_causes
from bench.worlds.follow import follow, table_of
from bench.worlds.world import Recipe
from visthrow.diagnose.inputs.measures import MEASUREMENTS
from visthrow.diagnose.planning.design import OPTIMISED
from visthrow.diagnose.planning.manoeuvres import Manoeuvre, catalogue
from visthrow.logs.flightlog import FlightLog

ROUNDS = 3
"""Sessions that are followed, one after the other."""
MOST_FLIGHTS = 4
"""Of one proposal."""
CLEAR = 3.0
"""Deviations from which a measurement shows that the configured value is off."""


def manoeuvre_of(proposal: str) -> Manoeuvre:
    """Return the manoeuvre of the tool's catalogue that a proposal flies, optimised or not."""
    return {m.name: m for m in catalogue()}[proposal.removesuffix(OPTIMISED)]


@dataclass(frozen=True)
class Pair:
    """A cause, and flights that hide which one it is."""

    effect: str
    size: float
    alike: frozenset[
        str
    ]  # a class is right that holds the effect and one of these; empty: it is NOT IDENTIFIABLE
    flights: tuple[str, ...]  # manoeuvres of the tool's catalogue, each flown twice
    payload: bool
    signs: tuple[float, ...] = (-1.0, 1.0)

    def run(self, recipe: Recipe, folder: Path) -> dict:
        """Fly, plan, follow the proposals, diagnose again."""
        tables = [
            table_of(manoeuvre_of(name).csv(), self.payload)
            for name in self.flights
            for _ in range(2)
        ]
        logs = [flight_log(record) for record in follow(recipe, tables, 0)]
        about = ("--about", self.effect) if not self.alike else ()
        answer = first = explain_logs(folder, logs, recipe, action="plan", more=about)
        done = []
        measured = []
        for number in range(1, ROUNDS + 1):
            if number > 1:
                answer = explain_logs(folder, logs, recipe, action="plan", more=(*about, *measured))
            if not answer["session"]:
                break
            for proposal in (p for p in answer["proposals"] if p["name"] in answer["session"]):
                done.append((proposal["name"], proposal["repeats"]))
                effect = next((m for m in MEASUREMENTS if m.name == proposal["name"]), None)
                if effect is None:
                    payload = manoeuvre_of(proposal["name"]).payload
                    logs += self.fly_proposal(recipe, answer, proposal, payload, len(done))
                    continue
                error = effect.sd * np.random.default_rng([recipe.seed, len(done)]).normal()
                value = recipe.effects.get(effect.effect, 0.0) + error
                if abs(value) > CLEAR * effect.sd:
                    return self.line(first, answer, done, effect.effect == self.effect)
                measured += ["--measured", f"{effect.effect}={effect.sd}"]
            answer = explain_logs(folder, logs, recipe, more=measured)
            if self.names_alone(answer):
                break
        return self.line(first, answer, done, self.names_alone(answer))

    def fly_proposal(
        self, recipe: Recipe, answer: dict, proposal: dict, payload: bool, number: int
    ) -> list[FlightLog]:
        """Fly a proposal on the plant as often as it states, up to a limit."""
        table = table_of(answer["tables"][proposal["reference"]], payload)
        times = min(max(proposal["repeats"], 1), MOST_FLIGHTS)
        return [
            flight_log(record)
            for record in follow(
                replace(recipe, seed=recipe.seed + number), [table] * times, number
            )
        ]

    def names_alone(self, answer: dict) -> bool:
        """Whether the effect alone is named."""
        return named_causes(answer) == [{self.effect}]

    def admits_ambiguity(self, answer: dict) -> bool:
        """Whether the first answer reports that these flights cannot distinguish the causes."""
        if not self.alike:
            return (
                next(f["verdict"] for f in answer["findings"] if f["name"] == self.effect)
                == "NOT IDENTIFIABLE"
            )
        return any(self.effect in group and group & self.alike for group in named_causes(answer))

    def line(self, first: dict, last: dict, done: list, named: bool) -> dict:
        """The ledger's line."""
        return {
            "passed": self.admits_ambiguity(first) and named,
            "told": self.admits_ambiguity(first),
            "named": named,
            "done": done,
            "before": first,
            "said": last,
        }


DEGREE = 0.0175
"""One prior deviation of a tilt, as 0.5 m/s is of the wind [rad].

Two short hovers in gusts measure a tilt to 2 mrad. At 8 mrad they hold 4 nats for the best single
cause, and 3 for wind, frame, markers and drag together; a cause needs 7. Then "no effect; if
present at all, between 2 and 10 mrad" is the right answer, without a class."""
LATE = (1.0,)
"""The only sign in which a delay of commands and one of stamps are a pair: nothing is measured
before it happens, so that commands that act sooner have no partner.
"""
MILLIMETRES = 3e-3
GRAMS = 4e-3
"""Sizes that two short hovers hardly distinguish from other causes: up to 3 nats apart, where the
cause itself has 10 to 15.

Larger sizes are distinguished, since gusts make the payload swing: 8 mm of rope differ from 8 mm of
a marker by 2 to 4 nats on a string and by 13 on a rod, 6 g of payload by 2 to 4 nats from equal
lift or weight."""
HOVER = ("hover",)
BARE = ("hover without payload",)
DOUBLETS = ("rate doublets",)
TILTED = frozenset({"wind_x", "frame_tilt_y", "marker_rot_y", "com_x"})
LONGER = frozenset({"payload_marker_z", "payload_offset", "marker_off_z", "mount_z", "frame_scale"})
HEAVIER = frozenset({"rope_mass", "downwash", "mass_quad", "thrust_gain", "air_density", "wind_z"})
PAIRS = {
    "gain_over_mass": Pair(
        "thrust_gain", 0.03, frozenset({"mass_quad", "air_density"}), BARE, False
    ),
    "mass_over_gain": Pair(
        "mass_quad", 0.008, frozenset({"thrust_gain", "air_density"}), BARE, False
    ),
    "payload_or_rope": Pair("mass_payload", GRAMS, HEAVIER, HOVER, True),
    "wind_or_tilt": Pair("wind_x", 0.5, TILTED, BARE, False),
    "tilt_or_wind": Pair("frame_tilt_y", DEGREE, TILTED, BARE, False),
    "markers_or_wind": Pair("marker_rot_y", DEGREE, TILTED, BARE, False),
    "length_or_marker": Pair("rope_length", MILLIMETRES, LONGER, HOVER, True),
    "command_or_stamp": Pair(
        "cmd_delay", 0.006, frozenset({"mocap_delay_quad", "motor_tau"}), DOUBLETS, False, LATE
    ),
    "stamp_or_command": Pair(
        "mocap_delay_quad", 0.008, frozenset({"cmd_delay", "motor_tau"}), DOUBLETS, False, LATE
    ),
    "ground_from_afar": Pair("ground_effect", 1.5, frozenset(), HOVER, True, (1.0,)),
    "drag_at_rest": Pair("rotor_drag", 0.03, frozenset(), HOVER, True),
    "ball_at_rest": Pair("payload_drag", 2e-3, frozenset(), HOVER, True, (1.0,)),
    "lift_at_rest": Pair("translational_lift", 5e-3, frozenset(), HOVER, True),
}
"""The design's degenerate pairs that flights alone can separate, and effects that hover does not
excite.
"""
