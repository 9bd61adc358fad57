"""``visthrow diagnose apply``: write the extended configuration that a diagnosis asks for."""

import argparse
from pathlib import Path

from visthrow import config
from visthrow.common.arguments import declared
from visthrow.common.errors import DiagnoseError
from visthrow.config.effects import catalogue

HARM = 0.02  # share by which a channel may get worse on held-out flights


add_arguments = declared(__file__)


def run(args: argparse.Namespace) -> int:
    """Write the file."""
    import json

    from visthrow.common.storage import atomic_write
    from visthrow.diagnose.apply import patch
    from visthrow.diagnose.inputs import setup
    from visthrow.diagnose.inputs.model_arguments import THROW
    from visthrow.logs import BLACKBOX
    from visthrow.task import Experiment

    if Path(args.diagnosis).suffix.lower() in BLACKBOX:
        return _apply_firmware(args)
    try:
        report = json.loads(Path(args.diagnosis).read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        raise DiagnoseError(f"{args.diagnosis}: not readable as a diagnosis: {error}") from error
    theta, covariance = patch.read(report, args.diagnosis)
    model = report.get("model", THROW)
    of_throw = model == THROW and not args.config
    if args.laws and (why := setup.MODELS[model].lawless if model in setup.MODELS else ""):
        raise DiagnoseError(
            f"{args.diagnosis}: no law can act in the model '{model}': {why}; expected no --laws"
        )
    laws = patch.laws_of(report, args.diagnosis, args.laws)
    if of_throw:
        patch.refuse_strange(report, args.diagnosis, theta, catalogue(), THROW)
    theta, covariance = patch.with_scatter(theta, covariance, report)
    account = origin(report, args.diagnosis)
    if of_throw:
        theta, covariance, transient = patch.without_transient(theta, covariance)
        if transient:
            account.append(f"Not written: {', '.join(transient)}; a state of these flights only.")
            print(account[-1])
    if not theta and not laws:
        hint = ", but a law outside the catalogue explains the flights: --laws 1 writes it"
        what = "configuration" if of_throw else "setup"
        print(f"nothing to write{hint if report.get('laws') else ''}; the {what} stands as it is")
        return 0
    _bear_out(report, args.anyway)
    folder, option, schema = (
        ("train", "plant", Experiment) if of_throw else ("diagnose", "config", setup.Setup)
    )
    name = _made_with(report, args, option, folder)
    base = _named(folder, name)
    diagnosed = config.load(
        schema, config.find(folder, name), report.get("overrides", ()) if of_throw else ()
    )
    content = (
        patch.text(base, diagnosed, theta, covariance, args.plants, account, laws)
        if of_throw
        else patch.of_setup(base, diagnosed, report, args.diagnosis, account, args.laws)
    )
    atomic_write(args.out, content)
    config.load(schema, Path(args.out))  # as training, or the next diagnosis, will read it
    named = list(theta)
    for law in laws:
        named.append(f"{law.coefficient:.4g} {' '.join((*law.factors, law.vector))} ({law.block})")
    print(f"{args.out}: {', '.join(named)} on top of {base}")
    return 0


def _apply_firmware(args: argparse.Namespace) -> int:
    """Write the configuration that flies the rate controller of a blackbox's firmware."""
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
    base = _named("train", plant)
    experiment = load_experiment(plant)
    text = patch.with_firmware(args.diagnosis, base, experiment, args.hover, args.delay)
    atomic_write(args.out, text)
    config.load(Experiment, Path(args.out))
    print(f"{args.out}: the rate controller of {args.diagnosis} on top of {base}")
    return 0


def _bear_out(report: dict, anyway: bool) -> None:
    """Refuse what held-out flights deny.

    Raises DiagnoseError: they do, and nobody wants it all the same.
    """
    # of a law alone, held-out flights have not been asked
    doubts = harm(report) if report.get("theta") else []
    if doubts and not anyway:
        raise DiagnoseError(
            f"held-out flights do not bear this out: {'; '.join(doubts)}; --anyway writes it all"
            " the same"
        )


def _made_with(report: dict, args: argparse.Namespace, option: str, folder: str) -> str:
    """Name of the plant or config that was diagnosed: sizes are counted from there.

    Raises DiagnoseError: another one is asked for; neither the diagnosis nor the option names one.
    """
    recorded = report.get(option)
    requested = getattr(args, option)
    if not (recorded or requested):
        model = report.get("model", "throw")
        raise DiagnoseError(
            f"{args.diagnosis}: a diagnosis of the model '{model}' names no {option}; expected"
            f" --{option} NAME"
        )
    if recorded and requested and _named(folder, recorded) != _named(folder, requested):
        raise DiagnoseError(
            f"{args.diagnosis}: made with --{option} {recorded}; its sizes do not count from "
            f"{requested}"
        )
    return recorded or requested


def _named(folder: str, name: str) -> str:
    """Path under which another configuration finds one."""
    path = config.find(folder, name)
    shipped = path.is_relative_to(config.configs_root())
    return path.relative_to(config.configs_root()).as_posix() if shipped else str(path.resolve())


def harm(report: dict) -> list[str]:
    """Reasons against a diagnosis: channels that held-out flights show worse with it,
    or no better.
    """
    gain = report.get("gain") or {}
    reasons = []
    for c in gain.get("channels", ()):
        if c.get("before") and c["after"] > (1.0 + HARM) * c["before"]:
            reasons.append(f"{c['channel']} {100 * (c['after'] / c['before'] - 1):+.1f} %")
    nats = gain.get("nats_per_sample")
    if nats is not None and nats <= 0.0:
        reasons.append(f"log-likelihood {nats:+.3g} nats a sample")
    return reasons


def origin(report: dict, path: str) -> list[str]:
    """Lines on where a diagnosis comes from."""
    lines = [
        f"Extended by `visthrow diagnose apply` from {path}:"
        f" {report.get('overall', 'a diagnosis')}.",
        f"{report.get('flights', 0)} flights, {report.get('windows', 0)} windows,"
        f" {report.get('samples', 0)} samples.",
    ]
    provenance = report.get("provenance") or {}
    for name in ("commit", "time", "command"):
        if provenance.get(name):
            lines.append(f"{name}: {provenance[name]}")
    theta = report.get("theta", {})
    gain = report.get("gain") or {}
    for c in gain.get("channels", ()) if theta else ():
        lines.append(
            f"Held-out error of {c['channel']}: {c.get('before', 0.0):.3g} before,"
            f" {c.get('after', 0.0):.3g} after."
        )
    if landing := gain.get("landing"):
        lines.append(
            f"Landing error of {landing['throws']} throws: {landing['before']:.3g} m before,"
            f" {landing['after']:.3g} m after."
        )
    sizes = []
    for f in report.get("findings") or []:
        if f["name"] in theta and f.get("low") is not None:
            sizes.append(
                f"{f['name']} = {f['estimate']:.3g} {f['unit']} (95 %: {f['low']:.3g} to"
                f" {f['high']:.3g})."
            )
    if sizes:
        lines.append(
            "Sizes and intervals as `explain` printed them. The deviations below also allow for"
            " differences between flights."
        )
    lines += sizes
    for s in report.get("scatter") or []:
        if s["found"]:
            group = s.get("by", "flight")
            lines.append(
                f"Varies from {group} to {group}: {s['name']} {s['size']:.3g} {s['unit']}."
            )
    return lines
