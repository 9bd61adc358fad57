"""Diagnose a pendulum on an encoder: its model stands beside this program, in ``swing_model.py``.

    python examples/pendulum/diagnose_swing.py tests/data/real/pendulum_single/*.gz

A model of your own does what this one does: it names its effects, cuts logs into windows, simulates
them, and says what the sensors measure. The rest is `visthrow.diagnose`.
"""

import argparse
from pathlib import Path

from swing_model import ENCODER, PendulumModel

from visthrow.diagnose import diagnose
from visthrow.diagnose.inputs.setup import read_logs
from visthrow.diagnose.reporting.diagnosis_report import summary
from visthrow.diagnose.reporting.explain_cli import write_report


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("logs", nargs="+", help="tables with the columns t_s and theta_rad")
    parser.add_argument("--out", type=Path, help="folder for a page with pictures")
    args = parser.parse_args()
    logs = read_logs(args.logs, "pendulum_encoder")  # the mapping of columns
    model = PendulumModel(logs, ENCODER)
    diagnosis = diagnose(logs, model)
    if args.out is None:
        print(summary(diagnosis))
    else:
        write_report(args.out, diagnosis, model, logs, seed=0)


if __name__ == "__main__":
    main()
