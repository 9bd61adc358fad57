"""A diagnosis read from the JSON of ``explain``: sizes, laws, origin, and checks before use."""

import json
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from sim.effects.effect import Effect
from sim.params import LawParams
from visthrow.common.errors import DiagnoseError, suggest
from visthrow.diagnose.inputs.model_arguments import THROW
from visthrow.diagnose.models.catalogue import beyond_bounds
from visthrow.diagnose.models.model_interface import Sizes

HARM = 0.02  # largest relative increase of a channel's error on held-out flights


@dataclass(frozen=True)
class SavedDiagnosis:
    """The contents of a file that ``explain`` wrote."""

    report: Mapping[str, Any]
    path: str  # of the file, for messages

    @staticmethod
    def read(path: str) -> "SavedDiagnosis":
        """Read a file.

        Raises DiagnoseError: the file is not readable or holds no JSON."""
        try:
            return SavedDiagnosis(json.loads(Path(path).read_text(encoding="utf-8")), path)
        except (OSError, ValueError) as error:
            raise DiagnoseError(f"{path}: not readable as a diagnosis: {error}") from error

    @property
    def model(self) -> str:
        """Name of the diagnosed model."""
        return str(self.report.get("model", THROW))

    @cached_property
    def sizes(self) -> tuple[dict[str, float], np.ndarray]:
        """Sizes and covariance expected of a future flight.

        An effect that differs between flights has the mean of the diagnosed flights. Its variance
        between flights, and that between days, are added to the covariance.

        Raises DiagnoseError: an entry is missing or malformed."""
        try:
            theta = {str(name): float(size) for name, size in self.report["theta"].items()}
            covariance = np.array(self.report["covariance"], dtype=float)
        except (KeyError, TypeError, ValueError, AttributeError) as error:
            reason = f"it has no {error}" if isinstance(error, KeyError) else error
            raise DiagnoseError(
                f"{self.path}: not a diagnosis that `visthrow diagnose explain` wrote: {reason}"
            ) from error
        count = len(theta)
        if covariance.size != count**2:
            raise DiagnoseError(
                f"{self.path}: {count} effects and a covariance of {covariance.size} numbers;"
                f" expected {count**2}"
            )
        variance = dict.fromkeys(theta, 0.0)
        for row in self.report.get("scatter") or []:
            means = row.get("mean", {})
            for name in row["of"] if row["found"] else ():
                theta.setdefault(name, means.get(name, 0.0))
                variance[name] = variance.get(name, 0.0) + row["size"] ** 2
        whole = np.diag(list(variance.values()))
        whole[:count, :count] += np.reshape(covariance, (count, count))
        return theta, whole

    def laws(self, rank: int) -> list[LawParams]:
        """Return all laws of the explanation of this rank, from 1; none for 0.

        Raises DiagnoseError: there are fewer explanations, or a law does not fit the grammar.
        """
        laws = []
        for x in self.explanation(rank):
            factors = tuple(x["factors"])
            try:
                laws.append(LawParams(x["block"], factors, x["vector"], float(x["coefficient"])))
            except ValueError as error:
                raise DiagnoseError(f"{self.path}: {error}") from None
        return laws

    def explanation(self, rank: int) -> list[dict[str, Any]]:
        """Return the laws of the explanation of this rank, from 1, as ``explain`` wrote them; none
        for 0.

        Raises DiagnoseError: there are fewer explanations.
        """
        explanations = self.report.get("explanations") or []
        if rank > len(explanations):
            choices = f"expected a number up to {len(explanations)}"
            if not explanations:
                reasons = "; ".join(self.report.get("reasons") or ["none"])
                choices = (
                    "it holds none: a formula is a law only if held-out flights confirm its"
                    f" coefficient. Reasons of its verdict: {reasons}"
                )
            asked = f"--laws asks for number {rank} of its laws"
            raise DiagnoseError(f"{self.path}: {asked}; {choices}")
        return explanations[rank - 1] if rank else []

    def refuse_strange(self, theta: Sizes, effects: Mapping[str, Effect]) -> None:
        """Refuse effects that the model does not have, in name or unit, and sizes outside bounds.

        ``theta``: sizes that the model would have; ``effects``: the model's effects by name.
        Raises DiagnoseError: the model has no such effect, has it in another unit, or a size lies
        outside its bounds."""
        strange = [name for name in theta if name not in effects]
        if strange:
            raise DiagnoseError(
                f"{self.path}: not effects of the {self.model}: {', '.join(strange)};"
                f" {suggest(strange[0], effects)}"
            )
        findings = self.report.get("findings") or []
        units = {f["name"]: f["unit"] for f in findings if "unit" in f}
        for name, size in theta.items():
            effect = effects[name]
            if units.get(name, effect.unit) != effect.unit:
                raise DiagnoseError(
                    f"{self.path}: {name} in '{units[name]}'; the {self.model}'s {name} is in"
                    f" '{effect.unit}': of another model"
                )
            if beyond := beyond_bounds(effect, size):
                raise DiagnoseError(f"{self.path}: {beyond} in the {self.model}")

    def refuse_denied(self) -> None:
        """Refuse effects that held-out flights do not confirm.

        A diagnosis with laws alone passes: laws are not tested on held-out flights here.
        Raises DiagnoseError: a channel's error increases, or the log-likelihood does not."""
        gain = self.report.get("gain") or {}
        reasons = []
        for c in gain.get("channels", ()):
            if c.get("before") and c["after"] > (1.0 + HARM) * c["before"]:
                reasons.append(f"{c['channel']} {100 * (c['after'] / c['before'] - 1):+.1f} %")
        nats = gain.get("nats_per_sample")
        if nats is not None and nats <= 0.0:
            reasons.append(f"log-likelihood {nats:+.3g} nats a sample")
        if reasons and self.report.get("theta"):
            raise DiagnoseError(
                f"held-out flights do not confirm this: {'; '.join(reasons)}; --anyway writes it"
                " all the same"
            )

    def origin(self) -> list[str]:
        """Return lines on the diagnosis' origin, and the lines that ``explain`` printed."""
        lines = [f"Extended by `visthrow diagnose apply` from {self.path}."]
        provenance = self.report.get("provenance") or {}
        for name in ("commit", "time", "command"):
            if provenance.get(name):
                lines.append(f"{name}: {provenance[name]}")
        return [
            *lines,
            *self.report.get("summary", ()),
            "The standard deviations below include differences between flights.",
        ]
