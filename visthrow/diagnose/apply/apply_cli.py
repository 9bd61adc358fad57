"""``visthrow diagnose apply``: write the configuration extended by a diagnosis."""

import argparse
from pathlib import Path
from typing import TYPE_CHECKING

from visthrow import config
from visthrow.common.arguments import declare
from visthrow.common.errors import DiagnoseError
from visthrow.config.effects import catalogue

if TYPE_CHECKING:
    from visthrow.diagnose.apply.saved_diagnosis import SavedDiagnosis

add_arguments = declare(__file__)


def run(args: argparse.Namespace) -> int:
    """Write the extended configuration, or that of a blackbox's firmware."""
    from visthrow.common.storage import atomic_write
    from visthrow.diagnose.apply import patch
    from visthrow.diagnose.apply.saved_diagnosis import SavedDiagnosis
    from visthrow.diagnose.inputs import setup
    from visthrow.diagnose.inputs.model_arguments import THROW
    from visthrow.logs import BLACKBOX
    from visthrow.task import Experiment

    if Path(args.diagnosis).suffix.lower() in BLACKBOX:
        return _apply_firmware(args)
    saved = SavedDiagnosis.read(args.diagnosis)
    of_throw = saved.model == THROW and not args.config
    lawless = setup.MODELS[saved.model].lawless if saved.model in setup.MODELS else ""
    if args.laws and lawless:
        raise DiagnoseError(
            f"{saved.path}: no law can act in the model '{saved.model}': {lawless}; expected no"
            " --laws"
        )
    theta, covariance = saved.sizes
    laws = saved.laws(args.laws)
    account = saved.origin()
    if of_throw:
        saved.refuse_strange(theta, catalogue())
        theta, covariance, transient = patch.without_transient(theta, covariance)
        if transient:
            account.append(f"Not written: {', '.join(transient)}; a state of these flights only.")
            print(account[-1])
    if not theta and not laws:
        hint = ", but a law outside the catalogue explains the flights: --laws 1 writes it"
        what = "configuration" if of_throw else "setup"
        law = hint if saved.report.get("explanations") else ""
        print(f"nothing to write{law}; the {what} is unchanged")
        return 0
    if not args.anyway:
        saved.refuse_denied()
    folder, option, schema = (
        ("train", "plant", Experiment) if of_throw else ("diagnose", "config", setup.Setup)
    )
    name = _plant_of_report(saved, getattr(args, option), option, folder)
    base = _path_from(folder, name)
    diagnosed = config.load(
        schema, config.find(folder, name), saved.report.get("overrides", ()) if of_throw else ()
    )
    content = (
        patch.text(base, diagnosed, theta, covariance, args.plants, account, laws)
        if of_throw
        else patch.of_setup(base, diagnosed, saved, account, args.laws)
    )
    atomic_write(args.out, content)
    config.load(schema, Path(args.out))  # checks that training, or the next diagnosis, can read it
    of_laws = [
        f"{law.coefficient:.4g} {' '.join((*law.factors, law.vector))} ({law.block})"
        for law in laws
    ]
    print(f"{args.out}: {', '.join([*theta, *of_laws])} on top of {base}")
    return 0


def _apply_firmware(args: argparse.Namespace) -> int:
    """Write the configuration with the rate controller of a blackbox's firmware."""
    from visthrow.common.storage import atomic_write
    from visthrow.diagnose.apply import patch
    from visthrow.diagnose.inputs.model_arguments import DEFAULT_PLANT
    from visthrow.task import Experiment, load_experiment

    if args.hover is None:
        raise DiagnoseError(
            "a blackbox without --hover; expected the share of throttle in hover, such as"
            " --hover 0.36"
        )
    plant = args.plant or DEFAULT_PLANT
    base = _path_from("train", plant)
    experiment = load_experiment(plant)
    text = patch.with_firmware(args.diagnosis, base, experiment, args.hover, args.delay)
    atomic_write(args.out, text)
    config.load(Experiment, Path(args.out))
    print(f"{args.out}: the rate controller of {args.diagnosis} on top of {base}")
    return 0


def _plant_of_report(
    saved: "SavedDiagnosis", requested: str | None, option: str, folder: str
) -> str:
    """Return the name of the diagnosed plant or setup, to which the sizes are relative.

    ``option``: "plant" or "config". Raises DiagnoseError: the option names another one than the
    diagnosis, or neither names one.
    """
    recorded = saved.report.get(option)
    if not (recorded or requested):
        raise DiagnoseError(
            f"{saved.path}: a diagnosis of the model '{saved.model}' names no {option}; expected"
            f" --{option} NAME"
        )
    if recorded and requested and _path_from(folder, recorded) != _path_from(folder, requested):
        raise DiagnoseError(
            f"{saved.path}: made with --{option} {recorded}; its sizes do not count from"
            f" {requested}; expected no --{option}, or the same"
        )
    return recorded or requested


def _path_from(folder: str, name: str) -> str:
    """Return the path by which another configuration refers to this one."""
    path = config.find(folder, name)
    shipped = path.is_relative_to(config.configs_root())
    return path.relative_to(config.configs_root()).as_posix() if shipped else str(path.resolve())
