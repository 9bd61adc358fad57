"""What a diagnosis says: one verdict for every effect, one overall, and the way that led there.

Plain data, ready for JSON.
"""

from collections.abc import Mapping
from dataclasses import asdict, dataclass, field, replace
from math import isnan
from typing import Any

from sim.params import LawParams
from visthrow.diagnose.select.candidates import Scatter, unit_suffix
from visthrow.diagnose.throw.command_mistakes import Mistake

FOUND = "FOUND"
CLASS = "CLASS"
BOUNDED = "BOUNDED"
CANDIDATE = "CANDIDATE"
NAMED = (FOUND, CLASS, CANDIDATE)  # verdicts on effects that the flights ask for
NOT_IDENTIFIABLE = "NOT IDENTIFIABLE"
UNOBSERVABLE = "UNOBSERVABLE"
VERDICTS = {
    FOUND: "the model lacks it, and nothing else in the catalogue says the same",
    CLASS: "this or one of its partners; these flights cannot tell which",
    CANDIDATE: (
        "the flights ask for it, but held-out flights do not confirm it, the search does not"
        " always name it without some of them, or sets of causes without it are nearly as likely"
    ),
    BOUNDED: (
        "the flights do not ask for it; if it is present all the same, then within these limits,"
        " which need not include 0"
    ),
    NOT_IDENTIFIABLE: (
        "these flights say hardly more than was known before, or it explains a part of what is"
        " missing, but not its form"
    ),
    UNOBSERVABLE: "a channel is missing that would show it",
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
    KNOWN: "the causes named explain the flights",
    IN_PART: (
        "the causes named explain a part of the flights, as held-out ones confirm; more is left"
        " than noise"
    ),
    UNKNOWN: "something is missing that no cause of the catalogue is shown to explain",
    INCONSISTENT: "the channels do not belong together; no cause can be named",
    OUT_OF_DOMAIN: "the simulation cannot follow these flights; no cause can be named",
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
    # size with all other effects free below their floors; of a class's member if it is the cause;
    # else 0 [unit]
    estimate: float
    sd: float  # likewise, of these flights, and what numerics add [unit]
    low: float  # 95 % interval [unit]
    high: float
    floor: float  # [unit]
    nats: float  # by which naming it raises the evidence
    partners: tuple[str, ...] = ()  # other members of its class
    joint: str = ""  # the combination of a class that is known
    missing: tuple[str, ...] = ()  # channels that would show it
    manoeuvres: tuple[str, ...] = ()  # that would separate or show it
    sentence: str = ""
    differs: float = 0.0  # deviation by which another flight may differ from these [unit]


def bounded(finding: Finding) -> Finding:
    """Return the finding as a bound on an effect that need not exist."""
    unit = unit_suffix(finding.unit)
    limits = f"{finding.low:.3g} and {finding.high:.3g}{unit}"
    sentence = f"{finding.name}: between {limits}, if present at all."
    return replace(finding, verdict=BOUNDED, estimate=0.0, partners=(), joint="", sentence=sentence)


@dataclass(frozen=True)
class SelectionStep:
    """One addition of the search, of one cause or of several at once, or an exchange of all names
    for a set that says more.
    """

    named: str  # names of a set with commas between them
    nats: float  # against what was named before; a step gains more than ENOUGH_NATS
    screened: Mapping[str, float]  # effect or set -> nats by the linear statistics, best first
    refitted: Mapping[str, float]  # effect or set -> nats with the simulation run again


@dataclass(frozen=True)
class Level:
    """Latent force of one block in one phase: what moved the vehicle besides the model."""

    block: str
    phase: str
    before: float  # with the model as it stands [N or N m]
    after: float  # with what was named
    quiet: float  # of the quietest phase, afterwards
    nats: float  # against its being as low as that times UNKNOWN_RATIO
    excessive: bool


@dataclass(frozen=True)
class Law(LawParams):
    """A law outside the catalogue, as it was found."""

    formula: str
    sd: float  # of the coefficient
    unit: str
    nats: float  # of evidence, less the log of the number of terms tried
    covariance: tuple[
        float, ...
    ] = ()  # of its coefficient with those of all laws of its explanation, in their order


@dataclass(frozen=True)
class ChannelGain:
    """Prediction error on held-out flights of one channel; root mean squares in ``unit``."""

    channel: str
    unit: str
    before: float
    after: float
    floor: float  # of sensor noise and of the initial state's uncertainty
    blackbox: float  # NaN where none can be, or was, trained
    gain: float  # 1 - after / before
    low: float  # 95 % interval of the gain, by the scatter of flights; NaN where one has all
    high: float
    # horizon [s], before, after, floor, in sigmas
    horizons: tuple[tuple[float, float, float, float], ...]

    @property
    def interval(self) -> str:
        """Return the interval in per cent as text; a single flight with the channel gives none."""
        if isnan(self.low):
            return "[no interval]"
        low, high = (round(100.0 * share, 0) + 0.0 for share in (self.low, self.high))  # no -0
        return f"[{low:.0f}, {high:.0f}]"


@dataclass(frozen=True)
class HeldOut:
    """The judgement of held-out flights on a set of names."""

    # what the names brought there, of the nats that they promise: 1 as promised, 0 nothing
    share: float
    low: float  # 95 % interval of the share
    high: float
    channels: tuple[ChannelGain, ...]
    named_in: Mapping[str, float] = field(
        default_factory=dict
    )  # effect -> share of folds that named it
    folds: int = 0
    left_out: str = "flights"  # or "parts of flights"


@dataclass(frozen=True)
class Diagnosis:
    """The whole answer.

    ``work`` holds what report, gain, plan and blind calculate with, and is not written to JSON.
    """

    overall: str
    block: str  # of an unknown effect, else empty
    reasons: tuple[str, ...]  # for the overall verdict
    findings: tuple[Finding, ...]  # one an effect, in the model's order
    # what to set in the model: the findings' sizes of named effects, one of each class
    theta: Mapping[str, float]
    covariance: tuple[tuple[float, ...], ...]  # of theta's entries, in their units
    threshold: float  # [nats]
    steps: tuple[SelectionStep, ...] = ()
    sets: tuple[
        tuple[tuple[str, ...], float], ...
    ] = ()  # sets of causes within 3 nats of the best, with their distance
    levels: tuple[Level, ...] = ()
    laws: tuple[Law, ...] = ()  # terms outside the catalogue, best first
    events: tuple[int, ...] = ()  # flights in which something happened once
    # by how much effects of a single flight differ there, as "thrust_gain in flight 3"
    alone: dict[str, float] = field(default_factory=dict)
    duplicates: Mapping[int, int] = field(
        default_factory=dict
    )  # flight -> the earlier flight that it repeats
    sensor_scale: Mapping[str, float] = field(
        default_factory=dict
    )  # channel -> noise found, in that stated
    flights: int = 0
    windows: int = 0
    samples: int = 0
    seconds: float = 0.0
    seed: int = 0
    scatter: tuple[Scatter, ...] = ()  # what may vary from flight to flight
    mistakes: tuple[
        Mistake, ...
    ] = ()  # of the logs' interface, put right before anything was estimated
    explanations: tuple[
        tuple[Law, ...], ...
    ] = ()  # terms that belong together, one such set in place of another, best first
    held_out: HeldOut | None = None  # where something was named
    work: Any = field(default=None, repr=False, compare=False)

    def __getitem__(self, name: str) -> Finding:
        """Return the verdict on an effect."""
        return next(f for f in self.findings if f.name == name)

    @property
    def named(self) -> tuple[str, ...]:
        """Effects of ``theta``."""
        return tuple(self.theta)

    @property
    def expected(self) -> dict[str, float]:
        """Return the sizes that another flight is expected to have: those named, and the means of
        what varies.
        """
        means = {name: mean for s in self.scatter if s.found for name, mean in s.mean.items()}
        return means | dict(self.theta)

    def to_dict(self) -> dict[str, Any]:
        """All but ``work``, for JSON."""
        plain = asdict(replace(self, work=None))
        del plain["work"]
        return plain
