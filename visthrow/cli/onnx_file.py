"""Export of a policy to ONNX, opset 17, in one file."""

from pathlib import Path

import numpy as np
from numpy import ndarray

from visthrow.common.storage import atomic_write
from visthrow.onboard.estimator import Estimator
from visthrow.onboard.policy import Policy, named_activation

OPSET = 17


def write_onnx(policy: Policy, path: str | Path) -> None:
    """Write the policy's network as ONNX, whole or not at all.

    Inputs: ``obs``, float32, shape (E, D). A policy with a memory also has ``memory``, shape
    (E, H), zeros at the start of a throw. Outputs: ``action``, normalised and unclipped, shape
    (E, A), and ``next_memory``, shape (E, H).

    Raises PolicyError if ONNX has no operator for the activation."""
    import onnx

    graph = _Graph()
    outputs = [("action", policy.action_dim)]
    inputs = [("obs", policy.obs_dim)]
    features = "obs"
    if policy.estimator is not None:
        inputs.append(("memory", policy.estimator.memory))
        outputs.append(("next_memory", policy.estimator.memory))
        features = _add_estimator(graph, policy.estimator)
    _add_network(graph, policy, features)

    def described(parts: list[tuple[str, int]]) -> list[onnx.ValueInfoProto]:
        float32 = onnx.TensorProto.FLOAT
        return [onnx.helper.make_tensor_value_info(n, float32, ["E", width]) for n, width in parts]

    model = onnx.helper.make_model(
        onnx.helper.make_graph(
            graph.nodes, "visthrow_policy", described(inputs), described(outputs), graph.constants
        ),
        opset_imports=[onnx.helper.make_opsetid("", OPSET)],
        ir_version=8,
    )
    onnx.checker.check_model(model, full_check=True)
    atomic_write(Path(path), model.SerializeToString())


class _Graph:
    """Nodes and constants of an ONNX graph, with unique names."""

    def __init__(self) -> None:
        self.nodes: list = []
        self.constants: list = []

    def constant(self, values: ndarray) -> str:
        """Add an array and return its name."""
        import onnx

        name = f"constant_{len(self.constants)}"
        self.constants.append(onnx.numpy_helper.from_array(values, name))
        return name

    def node(self, operator: str, *inputs: str, output: str = "", **attributes: object) -> str:
        """Add an operation and return the name of its output."""
        import onnx

        output = output or f"value_{len(self.nodes)}"
        self.nodes.append(onnx.helper.make_node(operator, list(inputs), [output], **attributes))
        return output

    def linear(self, x: str, weight: ndarray, bias: ndarray, output: str = "") -> str:
        """Add ``x W^T + b``."""
        names = self.constant(weight), self.constant(bias)
        return self.node("Gemm", x, *names, output=output, transB=1)


def _add_network(graph: _Graph, policy: Policy, features: str) -> None:
    """Add the perceptron with its normaliser."""
    operator = named_activation(policy, "onnx", f"ONNX operator in opset {OPSET}")
    x = features
    if policy.mean is not None and policy.std is not None:
        mean = graph.constant(policy.mean.cpu().numpy())
        scale = graph.constant((policy.std + policy.eps).cpu().numpy())
        x = graph.node("Div", graph.node("Sub", x, mean), scale)
    last = len(policy.weights) - 1
    for i, (weight, bias) in enumerate(zip(policy.weights, policy.biases)):
        arrays = weight.cpu().numpy(), bias.cpu().numpy()
        x = graph.linear(x, *arrays, output="action" if i == last else "")
        if i < last:
            x = graph.node(operator, x)


def _add_estimator(graph: _Graph, estimator: Estimator) -> str:
    """Add the recurrent estimator and return the name of its estimate."""
    part = {name: value.cpu().numpy() for name, value in estimator.parts().items()}
    centred = graph.node("Sub", "obs", graph.constant(part["mean"]))
    scaled = graph.node("Div", centred, graph.constant(part["std"]))
    x = scaled
    for name in ("encoder", *(f"inner{i}" for i in range(len(estimator.inner)))):
        x = graph.node("Elu", graph.linear(x, part[f"{name}_weight"], part[f"{name}_bias"]))
    weights = [graph.constant(_gates(part[f"{name}_weight"])) for name in ("input", "memory")]
    biases = [_gates(part[f"{name}_bias"]) for name in ("input", "memory")]
    weights.append(graph.constant(np.concatenate(biases, axis=1)))
    first = graph.constant(np.array([0]))
    steps, begun = (graph.node("Unsqueeze", value, first) for value in (x, "memory"))
    sizes = {"hidden_size": estimator.memory, "linear_before_reset": 1}
    after = graph.node("GRU", steps, *weights, "", begun, **sizes)  # steps, directions, E, H
    memory = graph.node("Squeeze", after, graph.constant(np.array([0, 1])), output="next_memory")
    padded = graph.node("Pad", "obs", graph.constant(np.array([0, 0, 0, 1])))
    direct = graph.node("Gather", padded, graph.constant(part["kept"]), axis=1)
    correction = graph.linear(memory, part["output_weight"], part["output_bias"])
    return graph.node("Add", direct, correction)


def _gates(torch_gates: ndarray) -> ndarray:
    """Return torch's gates (reset, update, new) in ONNX's order, with its axis of directions."""
    reset, update, new = np.split(torch_gates, 3)
    return np.concatenate([update, reset, new])[None]
