"""ArduPilot's SYSTEMID in its log, and the settings that ask for sweeps."""

import math

import numpy as np
from pytest import mark

from tests.logfiles import ATT, write_bin
from visthrow import logs
from visthrow.diagnose.planning import manoeuvre_excitation as excitation

IMU = ("QBffffff", "TimeUS,I,GyrX,GyrY,GyrZ,AccX,AccY,AccZ")
RATE = ("Qffffff", "TimeUS,RDes,R,PDes,P,YDes,Y")
SIDS = ("QBfffffff", "TimeUS,Ax,Mag,FSt,FSp,TFin,TC,TR,TFout")
SIDD = ("Qfffffffff", "TimeUS,Time,Targ,F,Gx,Gy,Gz,Ax,Ay,Az")


@mark.parametrize(("axis", "sign"), [(7, 1.0), (8, -1.0), (9, -1.0)])
def test_a_sweep_is_part_of_the_commanded_rate(tmp_path, axis, sign):
    """Forward, right, down in the log: a sweep about y and z turns round in our frame; before and
    after it nothing is added.
    """
    rows = []
    for n in range(400):
        us = 10_000 * n
        rows += [
            ("IMU", (us, 0, 0.0, 0.0, 0.0, 0.0, 0.0, -9.81)),
            ("ATT", (us, *[0.0] * 6)),
            ("RATE", (us, 5.0, 0.0, 5.0, 0.0, 5.0, 0.0)),
        ]
        if n == 100:
            rows.append(("SIDS", (us, axis, 86.0, 0.5, 15.0, 2.0, 0.0, 20.0, 2.0)))
        if 100 <= n < 300:
            rows.append(("SIDD", (us, 0.0, 80.0 * math.sin(0.1 * n), 1.0, *[0.0] * 6)))
    path = tmp_path / "sweep.bin"
    write_bin(path, {"IMU": IMU, "ATT": ATT, "RATE": RATE, "SIDS": SIDS, "SIDD": SIDD}, rows)
    log = logs.read(path)[0]
    rates, n = np.degrees(log["rate_setpoint_b"].values), np.arange(400)
    swept = np.where((n >= 100) & (n < 300), 80.0 * np.sin(0.1 * n), 0.0)
    expected = np.array([5.0, -5.0, -5.0]) * np.ones((400, 3))
    expected[:, axis - 7] += sign * swept
    np.testing.assert_allclose(rates, expected, atol=1e-3)
    assert log.meta["ingest"]["rate_setpoint_b"]["sweep"].startswith(f"SIDD about axis {axis - 7}")


def test_settings_of_sweeps(tmp_path):
    """Amplitudes in deg/s, frequencies in Hz and tenths, the modes by their numbers."""
    files = {path.name: path.read_text() for path in excitation.write(tmp_path)}
    chirp = files["betaflight_chirp.txt"].splitlines()
    assert "set chirp_amplitude_roll = 86" in chirp
    assert "set chirp_frequency_start_deci_hz = 5" in chirp
    assert "set chirp_frequency_end_deci_hz = 150" in chirp
    assert "aux 3 55 4 1700 2100 0 0" in chirp
    yaw = dict(line.split(",") for line in files["ardupilot_systemid_yaw.param"].splitlines())
    assert yaw["SID_AXIS"] == "9"
    assert yaw["SID_MAGNITUDE"] == "57"
    assert float(yaw["SID_F_STOP_HZ"]) == 15.0
