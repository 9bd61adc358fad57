"""What an autopilot can excite by itself: sweeps of a rate's set-point, as settings of Betaflight's
CHIRP and ArduPilot's SYSTEMID.

A sweep of 20 s holds all frequencies between slow sway and the noise of the gyro, which a doublet
does not; the autopilot adds it behind the radio, at its own loop's rate. Its blackbox tells the
set-point with the sweep in it, ArduPilot's log the sweep beside it.

Source: betaflight 4.6, src/main/flight/pid.h (chirp_*), msp_box.c (CHIRP is mode 55); ArduCopter
mode_systemid.cpp (SID_*, mode 25)."""

import math
from pathlib import Path

from visthrow.common.storage import atomic_write

AMPLITUDES = (1.5, 1.5, 1.0)
"""Of the sweeps about x, y, z [rad/s]: those of the rate doublets, at which the motors of the
paper's vehicle do not saturate.
"""

LOW = 0.5
HIGH = 15.0
SECONDS = 20.0
"""First and last frequency [Hz]: a swing of the hover to three times a rate loop of 30 rad/s;
duration [s].
"""

FADE = 2.0  # in which ArduPilot's sweep begins and ends [s]

CHIRP_BOX = 55
SYSTEMID = 25

AXES = {"roll": 7, "pitch": 8, "yaw": 9}  # SID_AXIS of the sweeps of a rate


def betaflight() -> str:
    """Lines for Betaflight's command line (a build with CHIRP)."""
    lines = [
        (
            f"# a sweep of {LOW:g} to {HIGH:g} Hz each time that the mode CHIRP is switched on:"
            " roll, then pitch, then yaw"
        ),
        "# aux 3 is a place in the list of modes, channel 4 is AUX 5: change both to what is free",
        f"aux 3 {CHIRP_BOX} 4 1700 2100 0 0",
        *(
            f"set chirp_amplitude_{axis} = {math.degrees(size):.0f}"
            for axis, size in zip(AXES, AMPLITUDES)
        ),
        f"set chirp_frequency_start_deci_hz = {10 * LOW:.0f}",
        f"set chirp_frequency_end_deci_hz = {10 * HIGH:.0f}",
        f"set chirp_time_seconds = {SECONDS:.0f}",
        "# the filter of the sweep is flat: corners at the same frequency",
        "set chirp_lag_freq_hz = 30",
        "set chirp_lead_freq_hz = 30",
        "set debug_mode = CHIRP",
        "set blackbox_sample_rate = 1/4",
        "save",
    ]
    return "\n".join(lines) + "\n"


def ardupilot(axis: str) -> str:
    """A parameter file of ArduPilot for one axis, to be loaded before a flight of it; the sweep
    begins with the mode.
    """
    size = AMPLITUDES[list(AXES).index(axis)]
    values = {
        "SID_AXIS": AXES[axis],
        "SID_MAGNITUDE": round(math.degrees(size)),
        "SID_F_START_HZ": LOW,
        "SID_F_STOP_HZ": HIGH,
        "SID_T_FADE_IN": FADE,
        "SID_T_REC": SECONDS,
        "SID_T_FADE_OUT": FADE,
        "FLTMODE5": SYSTEMID,
        "LOG_DISARMED": 0,
    }
    return "".join(f"{name},{value:g}\n" for name, value in values.items())


def write(folder: str | Path) -> list[Path]:
    """Write the settings of all; returns the files."""
    files = {
        "betaflight_chirp.txt": betaflight(),
        **{f"ardupilot_systemid_{axis}.param": ardupilot(axis) for axis in AXES},
    }
    for name, text in files.items():
        atomic_write(Path(folder) / name, text)
    return [Path(folder) / name for name in files]
