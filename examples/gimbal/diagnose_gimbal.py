"""Diagnose a gimbal camera against motion capture, and test the answer on other flights.

    python examples/gimbal/diagnose_gimbal.py tests/data/slungload_camera/*.gz

The model stands beside this program, in ``gimbal_model.py``.
"""

import argparse

from gimbal_model import SLUNG_LOAD, GimbalModel

from visthrow.diagnose import diagnose
from visthrow.diagnose.inputs.setup import read_logs
from visthrow.diagnose.reporting.diagnosis_report import summary
from visthrow.diagnose.reporting.gain import evaluate_on_others


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("logs", nargs="+", help="tables with the columns of slungload_camera")
    parser.add_argument(
        "--test", nargs="*", default=[], help="flights to predict, unused otherwise"
    )
    args = parser.parse_args()
    logs = read_logs(args.logs, "slungload_camera")  # the mapping of columns
    diagnosis = diagnose(logs, GimbalModel(logs, SLUNG_LOAD))
    print(summary(diagnosis))
    if args.test:
        others = GimbalModel(read_logs(args.test, "slungload_camera"), SLUNG_LOAD)
        tested = evaluate_on_others(others, others, diagnosis.expected, diagnosis)
        for channel, (before, after, noise) in tested.errors.items():
            print(f"tested, {channel}: {before:.3g} -> {after:.3g} m, noise alone {noise:.3g}")


if __name__ == "__main__":
    main()
