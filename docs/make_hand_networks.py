"""Make tumble/preprocess/hands/networks.safetensors from the TensorFlow Lite files of MediaPipe's hand tracker.

    pip install tflite==2.18.0
    python docs/make_hand_networks.py FOLDER tumble/preprocess/hands/networks.safetensors

FOLDER holds `palm_detection_full.tflite` and `hand_landmark_full.tflite`, as in `mediapipe/modules` of the wheel
`mediapipe==0.10.21`. Their weights are float16 already, so none is rounded. Layers are numbered in the order in which
the network runs them, which is the order in which `tumble/preprocess/hands/networks.py` asks for them.
"""

import argparse
import hashlib
import sys
from pathlib import Path
from typing import Any

import numpy as np
import safetensors.numpy
import tflite

SHA256 = {
    "palm_detection_full": "1b14e9422c6ad006cde6581a46c8b90dd573c07ab7f3934b5589e7cea3f89a54",
    "hand_landmark_full": "11c272b891e1a99ab034208e23937a8008388cf11ed2a9d776ed3d01d0ba00e3",
}
DEPTHWISE, CONVOLUTION, DENSE, PRELU, DEQUANTIZE = (
    tflite.BuiltinOperator.DEPTHWISE_CONV_2D,
    tflite.BuiltinOperator.CONV_2D,
    tflite.BuiltinOperator.FULLY_CONNECTED,
    tflite.BuiltinOperator.PRELU,
    tflite.BuiltinOperator.DEQUANTIZE,
)


def constant(model: Any, graph: Any, index: int, halves: dict[int, int]) -> np.ndarray:
    """A weight tensor; `halves` says which float16 tensor a float32 one is converted from."""
    tensor = graph.Tensors(halves.get(index, index))
    assert tensor.Type() == tflite.TensorType.FLOAT16
    return model.Buffers(tensor.Buffer()).DataAsNumpy().view(np.float16).reshape(tensor.ShapeAsNumpy())


def layers(content: bytes) -> dict[str, np.ndarray]:
    """`K.weight` [out, in, height, width] or [out, in] and `K.bias` [out] of layer K; `K.slope` [out] of a PReLU."""
    model = tflite.Model.GetRootAsModel(content, 0)
    graph = model.Subgraphs(0)
    halves: dict[int, int] = {}
    tensors: dict[str, np.ndarray] = {}
    number = -1
    for operator in (graph.Operators(i) for i in range(graph.OperatorsLength())):
        kind = model.OperatorCodes(operator.OpcodeIndex()).DeprecatedBuiltinCode()
        inputs = operator.InputsAsNumpy()
        if kind == DEQUANTIZE:
            halves[operator.Outputs(0)] = inputs[0]
        if kind == PRELU:
            tensors[f"{number:02}.slope"] = constant(model, graph, inputs[1], halves).reshape(-1)
        if kind in (CONVOLUTION, DEPTHWISE, DENSE):
            number += 1
            weight = constant(model, graph, inputs[1], halves)
            axes = {CONVOLUTION: (0, 3, 1, 2), DEPTHWISE: (3, 0, 1, 2), DENSE: (0, 1)}[kind]
            tensors[f"{number:02}.weight"] = np.ascontiguousarray(weight.transpose(axes))
            tensors[f"{number:02}.bias"] = constant(model, graph, inputs[2], halves)
    return tensors


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path)
    parser.add_argument("output", type=Path)
    arguments = parser.parse_args()
    tensors: dict[str, np.ndarray] = {}
    for name, expected in SHA256.items():
        path = arguments.folder / f"{name}.tflite"
        content = path.read_bytes()
        if (digest := hashlib.sha256(content).hexdigest()) != expected:
            sys.exit(f"{path}: SHA-256 is {digest}, expected {expected}")
        tensors |= {f"{name.split('_')[0]}.{key}": value for key, value in layers(content).items()}
    # The last layer: landmarks in metres, which nobody asks for.
    del tensors["hand.50.weight"], tensors["hand.50.bias"]
    # One entry: safetensors writes several in an order that changes from run to run.
    header = {"source": "MediaPipe palm_detection_full and hand_landmark_full, Apache-2.0"}
    arguments.output.write_bytes(safetensors.numpy.save(dict(sorted(tensors.items())), header))


if __name__ == "__main__":
    main()
