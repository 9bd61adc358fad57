"""Diagnose the balance of four motors in slow flight: a weak motor, a weight on one arm.

    python examples/trim/diagnose_trim.py tests/data/real/crazypad_faults/cut_propeller*

The model stands beside this program, in ``trim_model.py``; ``--fit`` estimates the thrusts of an
unharmed vehicle, with which the model starts.
"""

import argparse

from trim_model import E8, E9, UNTRIMMED, TrimModel

from visthrow.diagnose import diagnose
from visthrow.diagnose.inputs.fit import fit
from visthrow.diagnose.inputs.setup import read_logs
from visthrow.diagnose.reporting.diagnosis_report import summary

MOTORS = ("motor_fl", "motor_fr", "motor_rl", "motor_rr")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("logs", nargs="+", help="tables with CrazyPAD's columns")
    parser.add_argument("--drone", choices=["E8", "E9"], default="E8")
    parser.add_argument("--fit", action="store_true", help="fit the motors of an unharmed vehicle")
    args = parser.parse_args()
    logs = read_logs(args.logs, "crazypad")  # the mapping of columns
    if args.fit:
        fitted = fit(TrimModel(logs, UNTRIMMED), MOTORS)
        print("\n".join(fitted.sentences))  # the thrust of each is 1 + its size
        return
    model = TrimModel(logs, {"E8": E8, "E9": E9}[args.drone])
    print(summary(diagnose(logs, model)))


if __name__ == "__main__":
    main()
