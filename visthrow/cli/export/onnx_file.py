"""Export a policy to one ONNX file with torch's exporter."""

import logging
from pathlib import Path

import torch
from torch import Tensor

from visthrow.common.storage import atomic_write
from visthrow.onboard.policy import Policy

OPSET = 18


class PolicyStep(torch.nn.Module):
    """A policy's step in the form that torch exports."""

    def __init__(self, policy: Policy):
        super().__init__()
        self.policy = policy

    def forward(self, obs: Tensor, memory: Tensor | None = None) -> tuple[Tensor, ...]:
        estimator = self.policy.estimator
        if estimator is None or memory is None:
            return (self.policy.decide(obs),)
        features, next_memory = estimator.step(obs, memory)
        return self.policy.decide(features), next_memory


def write_onnx(policy: Policy, path: str | Path) -> None:
    """Write the policy's network as ONNX, whole or not at all.

    Inputs: ``obs``, float32, shape (E, D). A policy with a memory also has ``memory``, shape
    (E, H), zeros at the start of a throw. Outputs: ``action``, normalised and unclipped, shape
    (E, A), and ``next_memory``, shape (E, H)."""
    batch = 2
    inputs = {"obs": torch.zeros(batch, policy.obs_dim)}
    outputs = ["action"]
    if policy.estimator is not None:
        inputs["memory"] = policy.begin(batch)
        outputs.append("next_memory")
    logging.getLogger("torch.onnx").setLevel(logging.ERROR)  # it warns that torchvision is missing
    program = torch.onnx.export(
        PolicyStep(policy).eval(),
        kwargs=inputs,
        input_names=list(inputs),
        output_names=outputs,
        opset_version=OPSET,
        dynamic_shapes={name: {0: torch.export.Dim.AUTO} for name in inputs},
        verbose=False,
    )
    atomic_write(Path(path), program.model_proto.SerializeToString())
