"""Diagnose a CSV of a thrown ball: read its columns, check them, and name what is missing.

python examples/diagnose_csv.py tests/data/real/jugglebot_throws/session7.csv.gz
"""

import argparse

from visthrow.diagnose import diagnose
from visthrow.diagnose.models.ball import BallModel, BallParams
from visthrow.diagnose.reporting.diagnosis_report import summary
from visthrow.logs import read
from visthrow.logs.mapping import ChannelMap, Split, TableMap, TimeColumn

TABLE = TableMap(
    time=TimeColumn(column="frame_300hz", unit="1/300 s"),
    split=Split(column="ball", gap=0.2, shortest=0.5),  # one log a track
    channels=(ChannelMap("payload_pos_w", ("x_mm", "y_mm", "z_mm"), "mm"),),
)
PARABOLA = BallParams(gravity=9.81, drag=0.0, edge=0.02, shortest=0.4, every=3)  # SI units


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("log")
    parser.add_argument("--tracks", type=int, default=4, help="that are used")
    args = parser.parse_args()
    logs = read(args.log, TABLE)
    used = logs[: args.tracks]
    diagnosis = diagnose(used, BallModel(used, PARABOLA), laws=False)
    print(f"{len(logs)} tracks, {len(used)} used")
    print(summary(diagnosis))


if __name__ == "__main__":
    main()
