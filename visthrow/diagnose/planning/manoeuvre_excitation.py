"""Settings with which autopilots sweep a rate's set-point: Betaflight's CHIRP and ArduPilot's
SYSTEMID.

Unlike a doublet, a sweep of 20 s excites all frequencies between slow sway and the noise of the
gyro. The autopilot adds it to the radio's commands at the rate of its control loop. Betaflight's
blackbox logs the set-point with the sweep included, ArduPilot logs the sweep separately."""

from pathlib import Path

from visthrow.common.storage import atomic_write
from visthrow.common.toml_text import tables_beside


def write(folder: str | Path) -> list[Path]:
    """Write the settings of all autopilots and axes; returns the files."""
    table = tables_beside(__file__)
    files = {"betaflight_chirp.txt": table["betaflight"]}
    for name, numbers in table["axes"].items():
        files[f"ardupilot_systemid_{name}.param"] = table["ardupilot"].format_map(numbers)
    for name, text in files.items():
        atomic_write(Path(folder) / name, text)
    return [Path(folder) / name for name in files]
