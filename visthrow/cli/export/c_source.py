"""Export a policy to C99: one file with constants and one function; no heap, only ``math.h``."""

from pathlib import Path

from torch import Tensor

from visthrow.common.storage import atomic_write
from visthrow.onboard.policy import Policy, name_activation
from visthrow.view.templates import render


def write_c(policy: Policy, path: str | Path) -> None:
    """Write the policy's network as a C file, whole or not at all.

    Raises PolicyError: the activation has no C expression."""
    estimator = policy.estimator
    encoder = []
    if estimator is not None:
        encoder = [estimator.encoder_bias, *(bias for _, bias in estimator.inner)]
    scale = None
    if policy.mean is not None and policy.std is not None:
        scale = policy.std + policy.eps
    source = render(
        Path(__file__).with_name("policy.c.j2"),
        {"array": _array},
        policy=policy,
        estimator=estimator,
        encoder=encoder,
        scale=scale,
        activation=name_activation(policy, "c", "C expression"),
    )
    atomic_write(path, source)


def _array(values: Tensor, name: str) -> str:
    """Return the definition of a constant array in C; nine digits represent a float32 exactly."""
    kind = "float" if values.is_floating_point() else "int"
    numbers = [str(v) if kind == "int" else f"{v:.9g}" for v in values.flatten().tolist()]
    if kind == "float":
        numbers = [f"{n}f" if "." in n or "e" in n else f"{n}.0f" for n in numbers]
    rows = [", ".join(numbers[i : i + 8]) for i in range(0, len(numbers), 8)]
    body = ",\n    ".join(rows)
    return f"\nstatic const {kind} {name}[{len(numbers)}] = {{\n    {body}}};\n"
