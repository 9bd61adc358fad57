"""Open-loop predictions of landings of throws through the firmware: by the training's vehicle, by
the firmware's settings, by the diagnosis.

    visthrow diagnose explain out/firmware/10*/... --plant out/doc.toml --out out/explain
        # of other throws
    python -m bench.sitl.landings out/firmware/11* --diagnosis out/explain/diagnosis.json

Each folder is a throw of `bench.sitl.direct`, with its run and its blackbox. The settings are those
in the first blackbox's header, with the hover's share of throttle and the commands' delay; nothing
is fitted to these throws but the state from which a prediction begins."""

import argparse
import json
import tempfile
from pathlib import Path

import numpy as np

from hil.params import HilParams
from visthrow import config
from visthrow.diagnose.apply import patch
from visthrow.diagnose.inputs import model_arguments as opening
from visthrow.task import Experiment

BASE = "vision"
DELAY = 0.028
"""The vehicle that the policy was trained in; from a decision to the firmware's mixer, with the
wait of `delay.hold` [s].
"""


def errors(logs: list[str], plant: str, theta: dict[str, float] | None = None) -> np.ndarray:
    """Horizontal distance of predicted from measured landings [m], shape (F,)."""
    args = argparse.Namespace(
        logs=logs, plant=plant, overrides=[], config=None, only=None, measured=[], device="cpu"
    )
    model = opening.Opened(args).model
    return model.landings(theta or {}).errors


def main() -> None:
    """Predict and print."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("throws", nargs="+", type=Path, metavar="FOLDER")
    parser.add_argument(
        "--diagnosis",
        type=Path,
        metavar="FILE",
        help="diagnosis.json of an explain on top of the settings",
    )
    args = parser.parse_args()
    boxes = [next(folder.glob("LOG*")) for folder in args.throws]
    logs = [
        f"{folder / 'run' / 'throw-01.npz'}+{box}"
        for folder, box in zip(args.throws, boxes, strict=True)
    ]
    hover = config.load(HilParams, config.find("hil", "betaflight_sitl")).betaflight.thrust.hover
    with tempfile.TemporaryDirectory() as name:
        plant = Path(name) / "settings.toml"
        path = config.find("train", BASE)
        plant.write_text(
            patch.with_firmware(boxes[0], str(path), config.load(Experiment, path), hover, DELAY)
        )
        distances = {"before": errors(logs, BASE), "settings": errors(logs, str(plant))}
        if args.diagnosis:
            distances["named"] = errors(
                logs, str(plant), json.loads(args.diagnosis.read_text())["theta"]
            )
    mean = {key: float(value.mean()) for key, value in distances.items()}
    less = {key: 1.0 - mean[key] / mean["before"] for key in mean if key != "before"}
    print(json.dumps({"throws": len(logs), "mean_m": mean, "less_by": less}, indent=1))


if __name__ == "__main__":
    main()
