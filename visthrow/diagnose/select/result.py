"""The result of a diagnosis: a verdict on every effect, an overall verdict, and how they came
about.

It is plain data, ready for JSON.
"""

from collections.abc import Mapping
from dataclasses import asdict, dataclass, field, replace
from math import isnan
from typing import Any

from sim.params import LawParams
from visthrow.diagnose.models.model_interface import Sizes
from visthrow.diagnose.select.candidates import Scatter, unit_suffix
from visthrow.diagnose.throw.command_mistakes import Mistake

FOUND = "FOUND"
CLASS = "CLASS"
BOUNDED = "BOUNDED"
CANDIDATE = "CANDIDATE"
NAMED = (FOUND, CLASS, CANDIDATE)  # verdicts on selected effects
NOT_IDENTIFIABLE = "NOT IDENTIFIABLE"
UNOBSERVABLE = "UNOBSERVABLE"
VERDICTS = {
    FOUND: "the model lacks it, and nothing else in the catalogue explains the same",
    CLASS: "this effect or one of its partners; these flights cannot tell which",
    CANDIDATE: (
        "selected, but held-out flights do not confirm it, the search does not always select it"
        " without some of them, or sets of causes without it are nearly as likely"
    ),
    BOUNDED: (
        "not needed to explain the flights; if present all the same, then within these limits,"
        " which need not include 0"
    ),
    NOT_IDENTIFIABLE: (
        "these flights hardly add to the prior, or it explains a part of the error, but not its"
        " form"
    ),
    UNOBSERVABLE: "a channel that would show it is missing",
}
"""Verdicts on one effect; each effect has exactly one."""

NO_EFFECT = "NO EFFECT"
KNOWN = "KNOWN"
IN_PART = "EXPLAINED IN PART"
UNKNOWN = "UNKNOWN"
INCONSISTENT = "DATA INCONSISTENT"
OUT_OF_DOMAIN = "OUT OF DOMAIN"
OVERALL = {
    NO_EFFECT: "the model explains the flights",
    KNOWN: "the causes found explain the flights",
    IN_PART: ("held-out flights confirm the causes found, but an error above the noise remains"),
    UNKNOWN: "the model lacks something that no cause of the catalogue is shown to explain",
    INCONSISTENT: "the channels contradict each other; no cause can be found",
    OUT_OF_DOMAIN: "the simulation cannot follow these flights; no cause can be found",
}


@dataclass(frozen=True)
class Finding:
    """The verdict on one effect."""

    name: str
    verdict: str
    block: str
    cause: str
    equation: str
    unit: str
    # size with all other effects free below their floors; for a member of a class, if it is the
    # cause; otherwise 0 [unit]
    estimate: float
    sd: float  # standard deviation of the size in these flights, with numerical error [unit]
    low: float  # 95 % interval [unit]
    high: float
    floor: float  # [unit]
    nats: float  # gain in evidence by selecting it
    partners: tuple[str, ...] = ()  # other members of its class
    joint: str = ""  # the combination of a class's sizes that is determined
    missing: tuple[str, ...] = ()  # channels that would show it
    manoeuvres: tuple[str, ...] = ()  # that would show it or separate it from its class
    sentence: str = ""
    differs: float = 0.0  # standard deviation between these flights and another [unit]


def bound(finding: Finding) -> Finding:
    """Turn a finding into a bound on an effect that need not be present."""
    unit = unit_suffix(finding.unit)
    limits = f"{finding.low:.3g} and {finding.high:.3g}{unit}"
    sentence = f"{finding.name}: between {limits}, if present at all."
    return replace(finding, verdict=BOUNDED, estimate=0.0, partners=(), joint="", sentence=sentence)


@dataclass(frozen=True)
class SelectionStep:
    """One step of the search to a better set."""

    named: str  # names of the set, separated by commas
    nats: float  # gain over the previous set, more than ENOUGH_NATS
    screened: Mapping[str, float]  # set -> gain by the linear statistics, best first
    refitted: Mapping[str, float]  # set -> gain by simulation


@dataclass(frozen=True)
class Level:
    """Standard deviation of the latent force on one block in one phase [N or N m]."""

    block: str
    phase: str
    before: float  # with nothing selected
    after: float  # with the selected effects
    quiet: float  # upper limit in the quietest phase, with the selected effects
    nats: float  # evidence that it exceeds UNKNOWN_RATIO times that
    excessive: bool


@dataclass(frozen=True)
class Law(LawParams):
    """A law outside the catalogue, with its estimated coefficient."""

    formula: str
    sd: float  # of the coefficient
    unit: str
    nats: float  # evidence, minus the log of the number of terms tried
    # of its coefficient with those of all laws of its explanation, in their order
    covariance: tuple[float, ...] = ()


@dataclass(frozen=True)
class ChannelGain:
    """Prediction error on held-out flights of one channel; root mean squares in ``unit``."""

    channel: str
    unit: str
    before: float
    after: float
    floor: float  # error expected from sensor noise and the initial state's uncertainty
    blackbox: float  # NaN if no black box was trained
    gain: float  # 1 - after / before
    low: float  # 95 % interval of the gain from the scatter of flights; NaN for a single flight
    high: float
    # horizon [s], before, after, floor, in sigmas
    horizons: tuple[tuple[float, float, float, float], ...]

    @property
    def interval(self) -> str:
        """Return the interval in per cent as text; a single flight has none."""
        if isnan(self.low):
            return "[no interval]"
        low, high = (round(100.0 * share, 0) + 0.0 for share in (self.low, self.high))  # no -0
        return f"[{low:.0f}, {high:.0f}]"


@dataclass(frozen=True)
class HeldOut:
    """The result of held-out flights for a set of selected effects."""

    share: float  # gain in evidence there, relative to the predicted one
    low: float  # 95 % interval of the share
    high: float
    channels: tuple[ChannelGain, ...]
    # effect -> share of folds that selected it
    named_in: Mapping[str, float] = field(default_factory=dict)
    folds: int = 0
    left_out: str = "flights"  # or "parts of flights"


@dataclass(frozen=True)
class Diagnosis:
    """A whole diagnosis.

    ``work`` is for the calculations of report, gain, plan and blind, and is not written to JSON.
    """

    overall: str
    block: str  # of an unknown effect, else empty
    reasons: tuple[str, ...]  # for the overall verdict
    findings: tuple[Finding, ...]  # one for each effect, in the model's order
    # sizes to be set in the model: those of selected effects, one of each class
    theta: Sizes
    covariance: tuple[tuple[float, ...], ...]  # of theta's entries, in their units
    threshold: float  # [nats]
    steps: tuple[SelectionStep, ...] = ()
    # sets of effects within 3 nats of the best, with their distance
    sets: tuple[tuple[tuple[str, ...], float], ...] = ()
    levels: tuple[Level, ...] = ()
    laws: tuple[Law, ...] = ()  # terms outside the catalogue, best first
    events: tuple[int, ...] = ()  # flights in which something unusual happened
    # deviations of effects in a single flight, by names such as "thrust_gain in flight 3"
    alone: dict[str, float] = field(default_factory=dict)
    duplicates: Mapping[int, int] = field(default_factory=dict)  # flight -> earlier equal flight
    # channel -> estimated noise relative to the stated one
    sensor_scale: Mapping[str, float] = field(default_factory=dict)
    flights: int = 0
    windows: int = 0
    samples: int = 0
    seconds: float = 0.0
    seed: int = 0
    scatter: tuple[Scatter, ...] = ()  # verdicts on what may vary between flights
    mistakes: tuple[Mistake, ...] = ()  # of the logs' commands, corrected before the selection
    # alternative sets of laws, best first
    explanations: tuple[tuple[Law, ...], ...] = ()
    held_out: HeldOut | None = None  # if any effect was selected
    work: Any = field(default=None, repr=False, compare=False)

    def __getitem__(self, name: str) -> Finding:
        """Return the verdict on an effect."""
        return next(f for f in self.findings if f.name == name)

    @property
    def named(self) -> tuple[str, ...]:
        """Return the names of the effects in ``theta``."""
        return tuple(self.theta)

    @property
    def expected(self) -> dict[str, float]:
        """Return the sizes expected in another flight: those in ``theta``, and the means of effects
        that vary.
        """
        means = {name: mean for s in self.scatter if s.found for name, mean in s.mean.items()}
        return means | dict(self.theta)

    def to_dict(self) -> dict[str, Any]:
        """Return all fields but ``work``, for JSON."""
        plain = asdict(replace(self, work=None))
        del plain["work"]
        return plain
