"""Sweeps of a rate's set-point that an autopilot flies by itself, as settings of Betaflight's CHIRP
and ArduPilot's SYSTEMID.

A sweep of 20 s holds all frequencies between slow sway and the noise of the gyro, which a doublet
does not; the autopilot adds it behind the radio, at its own loop's rate. Its blackbox tells the
set-point with the sweep in it, ArduPilot's log the sweep beside it."""

from pathlib import Path

from visthrow.common.storage import atomic_write
from visthrow.common.toml_text import tables_beside


def write(folder: str | Path) -> list[Path]:
    """Write the settings of all; returns the files."""
    table = tables_beside(__file__)
    files = {"betaflight_chirp.txt": table["betaflight"]}
    for name, numbers in table["axes"].items():
        files[f"ardupilot_systemid_{name}.param"] = table["ardupilot"].format_map(numbers)
    for name, text in files.items():
        atomic_write(Path(folder) / name, text)
    return [Path(folder) / name for name in files]
