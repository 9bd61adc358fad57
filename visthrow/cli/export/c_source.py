"""Export of a policy to C99: one file, constants and one function, no heap, only ``math.h``."""

from pathlib import Path

import numpy as np

from visthrow.common.storage import atomic_write
from visthrow.onboard.estimator import Estimator
from visthrow.onboard.policy import Policy, named_activation

HEAD = """\
/* Network of a visthrow policy. Generated; do not edit.

   visthrow_policy(obs, memory, action) computes the normalised, unclipped action of one step.
   obs: VISTHROW_OBS numbers, laid out as visthrow/onboard/observations.py says.
   memory: VISTHROW_MEMORY numbers, zeros at the start of a throw; updated in place.
   action: VISTHROW_ACTIONS numbers: thrust, three body rates, release. */
#include <math.h>

#define VISTHROW_OBS {obs}
#define VISTHROW_MEMORY {memory}
#define VISTHROW_ACTIONS {actions}

void visthrow_policy(const float *obs, float *memory, float *action);

static void linear(const float *w, const float *b, int rows, int columns, const float *x, float *y)
{{
    for (int i = 0; i < rows; i++) {{
        float sum = b[i];
        for (int j = 0; j < columns; j++)
            sum += w[i * columns + j] * x[j];
        y[i] = sum;
    }}
}}

static float activate(float x)
{{
    return {activation};
}}
"""

ESTIMATOR = """
static void estimate(const float *obs, float *memory, float *features)
{{
    float scaled[{obs}], input[{gates}], recurrent[{gates}];
    for (int i = 0; i < {obs}; i++)
        scaled[i] = (obs[i] - est_mean[i]) / est_std[i];
{encoder}    linear(input_weight, input_bias, {gates}, {encoded}, {source}, input);
    linear(memory_weight, memory_bias, {gates}, {memory}, memory, recurrent);
    for (int i = 0; i < {memory}; i++) {{
        float reset = 1.0f / (1.0f + expf(-(input[i] + recurrent[i])));
        float update = 1.0f / (1.0f + expf(-(input[{memory} + i] + recurrent[{memory} + i])));
        float new = tanhf(input[2 * {memory} + i] + reset * recurrent[2 * {memory} + i]);
        memory[i] = new + update * (memory[i] - new);
    }}
    linear(output_weight, output_bias, {estimate}, {memory}, memory, features);
    for (int i = 0; i < {estimate}; i++)
        if (kept[i] < {obs})
            features[i] += obs[kept[i]];
}}
"""


def write_c(policy: Policy, path: str | Path) -> None:
    """Write the policy's network as a C file, whole or not at all.

    Raises PolicyError if the activation has no expression here."""
    activation = named_activation(policy, "c", "C expression")
    estimator = policy.estimator
    memory = 0 if estimator is None else estimator.memory
    parts = [
        HEAD.format(
            obs=policy.obs_dim,
            memory=memory,
            actions=policy.action_dim,
            activation=activation,
        )
    ]
    if estimator is not None:
        parts.append(_estimator(estimator))
    parts.append(_network(policy))
    atomic_write(Path(path), "".join(parts).encode())


def _array(name: str, values: np.ndarray) -> str:
    """Return a constant array of C; float32 survives the nine digits."""
    kind = "int" if values.dtype.kind == "i" else "float"
    numbers = [str(v) if kind == "int" else f"{v:.9g}" for v in values.ravel().tolist()]
    if kind == "float":
        numbers = [f"{n}f" if "." in n or "e" in n else f"{n}.0f" for n in numbers]
    rows = [", ".join(numbers[i : i + 8]) for i in range(0, len(numbers), 8)]
    body = ",\n    ".join(rows)
    return f"\nstatic const {kind} {name}[{len(numbers)}] = {{\n    {body}}};\n"


def _estimator(estimator: Estimator) -> str:
    """Return constants and function of the recurrent estimator."""
    names = {"mean": "est_mean", "std": "est_std"}
    arrays = [
        _array(names.get(name, name), value.cpu().numpy())
        for name, value in estimator.parts().items()
    ]
    lines = []
    source = "scaled"
    width = estimator.obs_dim
    layers = [("encoder", estimator.encoder_bias)]
    layers += [(f"inner{i}", bias) for i, (_, bias) in enumerate(estimator.inner)]
    for name, bias in layers:
        lines += [
            f"    float {name}[{len(bias)}];",
            f"    linear({name}_weight, {name}_bias, {len(bias)}, {width}, {source}, {name});",
            f"    for (int i = 0; i < {len(bias)}; i++)",
            f"        {name}[i] = {name}[i] > 0.0f ? {name}[i] : expm1f({name}[i]);",
        ]
        source = name
        width = len(bias)
    function = ESTIMATOR.format(
        obs=estimator.obs_dim,
        encoder="\n".join(lines) + "\n",
        encoded=width,
        source=source,
        gates=3 * estimator.memory,
        memory=estimator.memory,
        estimate=estimator.output_weight.shape[0],
    )
    return "".join(arrays) + function


def _network(policy: Policy) -> str:
    """Return constants and the exported function."""
    width = policy.weights[0].shape[1]
    arrays = []
    lines = []
    if policy.estimator is None:
        lines += ["    const float *features = obs;", "    (void)memory;"]
    else:
        lines += [f"    float features[{width}];", "    estimate(obs, memory, features);"]
    source = "features"
    if policy.mean is not None and policy.std is not None:
        arrays.append(_array("mean", policy.mean.cpu().numpy()))
        arrays.append(_array("scale", (policy.std + policy.eps).cpu().numpy()))
        lines += [
            f"    float normalised[{width}];",
            f"    for (int i = 0; i < {width}; i++)",
            "        normalised[i] = (features[i] - mean[i]) / scale[i];",
        ]
        source = "normalised"
    last = len(policy.weights) - 1
    for i, (weight, bias) in enumerate(zip(policy.weights, policy.biases)):
        rows, columns = weight.shape
        arrays.append(_array(f"weight_{i}", weight.cpu().numpy()))
        arrays.append(_array(f"bias_{i}", bias.cpu().numpy()))
        target = "action" if i == last else f"layer_{i}"
        if i < last:
            lines.append(f"    float {target}[{rows}];")
        lines.append(f"    linear(weight_{i}, bias_{i}, {rows}, {columns}, {source}, {target});")
        if i < last:
            lines += [
                f"    for (int i = 0; i < {rows}; i++)",
                f"        {target}[i] = activate({target}[i]);",
            ]
        source = target
    head = "\nvoid visthrow_policy(const float *obs, float *memory, float *action)\n{\n"
    return "".join(arrays) + head + "\n".join(lines) + "\n}\n"
