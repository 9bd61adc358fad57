"""What differs from flight to flight: effects whose size is a deviation, told by how far the flights' own estimates scatter."""

from dataclasses import dataclass


@dataclass(frozen=True)
class Varying:
    """A quantity of the catalogue that is drawn anew in every flight, from a normal distribution about its mean."""

    name: str
    cause: str  # in words, as the first half of a sentence
    equation: str  # theta: the standard deviation
    of: tuple[str, ...]  # effects of the catalogue, in whose unit it is; of several one deviation for all
    unit: str
    block: str
    prior_sd: float  # of the deviation, where the quantity varies
    floor: float
    source: str
    confused_with: tuple[str, ...] = ()
    manoeuvres: tuple[str, ...] = ()


VARYING: tuple[Varying, ...] = (
    Varying("lag_jitter", "The payload leaves now sooner, now later", "tau_r ~ N(tau_r, theta^2) in each throw", ("release_lag",),
            "s", "release", 0.010, 2e-3, "50 Hz servo frames: uniform over 20 ms; 10 ms are 2.5 cm of landing",
            ("gust",), ("repeat identical throws",)),
    Varying("gust", "The air moves now this way, now that", "v_air ~ N(v_air, theta^2) in each flight, every axis",
            ("wind_x", "wind_y", "wind_z"), "m/s", "environment", 0.2, 0.05,
            "Fanger and Christensen 1984: turbulence of 30 to 60 % of a room's draught", ("lag_jitter",),
            ("hover with the fans off",)),
    Varying("cmd_jitter", "Commands arrive now sooner, now later", "tau_d ~ N(tau_d, theta^2) in each flight", ("cmd_delay",), "s",
            "command queue", 0.005, 1e-3, "Kaufmann et al. 2023; radio links repeat and reorder", ("mocap_delay_quad",),
            ("IMU or rotor speeds in the log",)),
)  # fmt: skip
"""Priors: half-normal with this deviation."""
