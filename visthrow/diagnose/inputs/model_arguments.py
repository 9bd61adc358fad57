"""Command line arguments of the diagnosis: from them, logs and the model to compare them with."""

import argparse
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import cached_property
from pathlib import Path
from typing import Any

from visthrow.common.arguments import declare
from visthrow.common.errors import ConfigError, DiagnoseError, expect_known
from visthrow.diagnose.inputs import measures, setup
from visthrow.diagnose.models.model_interface import Model
from visthrow.diagnose.select.diagnose_flights import correct_interface_mistakes, diagnose
from visthrow.diagnose.select.result import NAMED, Diagnosis
from visthrow.logs.check.rows import KnownVehicle
from visthrow.logs.check.run import check, label
from visthrow.logs.flightlog import FlightLog

DEFAULT_PLANT = "state"
THROW = "throw"  # name of the throw's model, for which a setup has no table


add_arguments = declare(__file__)


class Opened:
    """The logs of a command, and the model of them, built when first used.

    Attributes:
        logs: the logs as read; once the model is built, with commands corrected.
    """

    def __init__(self, args: argparse.Namespace):
        """Read the logs.

        Raises ConfigError, LogError: from :func:`visthrow.diagnose.inputs.setup.read_logs`."""
        self._args = args
        self.logs = setup.read_logs(args.logs, args.config)

    @cached_property
    def model(self) -> Model:
        """Build the model.

        Raises ConfigError, LogError, DiagnoseError: the model cannot be built, or ``--set`` is used
        with a setup's model."""
        args = self._args
        logs = self.logs
        chosen = setup.load(args.config)
        if not (chosen.model or chosen.example):
            model, self.logs = throw_model(args, logs)
        elif args.overrides:
            raise ConfigError(
                f"--set changes the throw's plant; the setup '{args.config}' has the model"
                f" {chosen.model}"
            )
        else:
            model = setup.model_of(chosen, logs)
            if args.only is not None:
                model.choose(args.only)
        if args.measured:
            model.effects = measures.narrow(model.effects, measures.parse(args.measured))
        # index of each flight's day: by the log's entry, or one day for each folder
        names = [
            str(log.meta.get("day") or Path(str(log.meta.get("source", ""))).parent) for log in logs
        ]
        model.days = tuple(map(list(dict.fromkeys(names)).index, names))
        return model

    @property
    def known(self) -> KnownVehicle:
        """Return the known properties of the vehicle, for checking logs."""
        vehicle = setup.describe_vehicle(self._args.config)
        return replace(vehicle, unread=vehicle.unread.union(self._args.overrule))

    def diagnose(self, laws: bool = True, say: Callable[[str], None] | None = None) -> Diagnosis:
        """Diagnose the flights with the options of the command line."""
        without = numbers(self._args.without, self.logs)
        if self._args.overrule:
            rows = [row for log in check(self.logs, self.known) for row in log.rows]
            bad = [row.name for row in rows if row.verdict == "bad"]
            expect_known(self._args.overrule, bad, "no bad row '{}' of check", DiagnoseError)
        diagnosis = diagnose(
            self.logs,
            lambda: self.model,
            vehicle=self.known,
            seed=self._args.seed,
            without=without,
            laws=laws,
            progress=say,
        )
        if not any(f.verdict in NAMED for f in diagnosis.findings) or not self.model.not_offered:
            return diagnosis
        note = (
            f"--only left {self.model.not_offered} effects out: one of them may be the true cause"
            " instead of those found"
        )
        return replace(diagnosis, reasons=(*diagnosis.reasons, note))


def describe_origin(args: argparse.Namespace) -> dict[str, Any]:
    """Return the entries of a diagnosis' JSON that state what was diagnosed.

    ``apply`` uses them to find the diagnosed configuration.
    """
    return {
        "model": setup.load(args.config).model or THROW,
        "plant": args.plant,
        "config": args.config,
        "overrides": args.overrides,
    }


def throw_model(
    args: argparse.Namespace, logs: Sequence[FlightLog]
) -> tuple[Model, list[FlightLog]]:
    """Build the throw's model with the plant of an experiment; return it with the logs after
    mistakes in their commands were corrected.
    """
    from visthrow.common.compute_device import resolve_for_warp
    from visthrow.diagnose.throw.throw_model import ThrowModel
    from visthrow.task import load_experiment, plant_of

    experiment = load_experiment(args.plant, args.overrides)
    plant = plant_of(experiment)
    options = {
        "sensing": experiment.sensing,
        "camera": experiment.camera,
        "device": resolve_for_warp(args.device),
        "only": args.only,
        "simpler": args.only is not None,
    }
    return correct_interface_mistakes(
        [log.without_estimates() for log in logs],
        plant,
        lambda logs: ThrowModel(logs, plant, **options),
    )


def numbers(text: str, logs: Sequence[FlightLog]) -> tuple[int, ...]:
    """Parse the numbers of the flights to leave out.

    Raises DiagnoseError: other text than numbers, no such flight, or all of them.
    """
    try:
        flights = tuple(int(part) for part in text.split(",") if part.strip())
    except ValueError as error:
        raise DiagnoseError(
            f"--without {text}; expected numbers of flights separated by commas, such as 0,3"
        ) from error
    listed = ", ".join(f"{i} ({label(log, i)})" for i, log in enumerate(logs))
    for number in flights:
        if not 0 <= number < len(logs):
            raise DiagnoseError(f"--without {text}: no flight {number}; the logs are {listed}")
    if len(set(flights)) == len(logs):
        raise DiagnoseError(f"--without {text} leaves no flight; the logs are {listed}")
    return flights
