"""The networks against TensorFlow Lite, where it is installed, and against numbers that it computed."""

from pathlib import Path

import numpy as np
import pytest
import torch

from tumble.preprocess.hands import networks

MODELS = Path(__file__).parents[4] / "shared/data/hand_nets"

PALM_LOGITS = (-6.4143, -5.9420, -9.3601, -9.8177, -7.2100)
PALM_VALUES = ((-1.8004, 6.5031, 6.2932, -0.7022), (24.0834, 22.9038, -3.9694, 3.1043))
LANDMARKS = ((115.1195, 169.9030, 0.0000), (108.3780, 78.9277, -1.5121), (84.8524, 90.1418, 1.6054))
PRESENCE_AND_RIGHT = (0.0083, 0.9240)


def pattern(side: int) -> torch.Tensor:
    """An image without symmetries, [1 3 side side] in [0, 1]."""
    rows, columns = torch.meshgrid(torch.arange(side), torch.arange(side), indexing="ij")
    return torch.stack([(rows / (7 + c) + columns / 23 + rows * columns / 999).sin() / 2 + 0.5 for c in range(3)])[None]


def lite(name: str, x: torch.Tensor) -> list[np.ndarray]:
    """Outputs of TensorFlow Lite, in the order of the file."""
    interpreter = pytest.importorskip("ai_edge_litert.interpreter", reason="ai-edge-litert is not installed")
    if not (MODELS / f"{name}.tflite").is_file():
        pytest.skip("needs shared/data/hand_nets")
    running = interpreter.Interpreter(str(MODELS / f"{name}.tflite"), num_threads=1)
    running.allocate_tensors()
    running.set_tensor(running.get_input_details()[0]["index"], x.permute(0, 2, 3, 1).contiguous().numpy())
    running.invoke()
    return [running.get_tensor(output["index"]) for output in running.get_output_details()]


def test_palms_are_those_of_tensorflow_lite() -> None:
    x = pattern(networks.PALM_SIDE)
    logits, values = networks.palms(x)
    expected_values, expected_logits = lite("palm_detection_full", x)
    # Sums of a few hundred float32 products, in another order.
    np.testing.assert_allclose(logits, expected_logits[..., 0], atol=2e-3)
    np.testing.assert_allclose(values, expected_values, atol=2e-3)


def test_landmarks_are_those_of_tensorflow_lite() -> None:
    x = pattern(networks.LANDMARK_SIDE)
    positions, presence, right = networks.landmarks(x)
    expected = lite("hand_landmark_full", x)
    np.testing.assert_allclose(positions.reshape(1, 63), expected[0], atol=2e-3)
    np.testing.assert_allclose(presence, expected[1][0], atol=1e-4)
    np.testing.assert_allclose(right, expected[2][0], atol=1e-4)


def test_networks_give_recorded_numbers() -> None:
    """Recorded from TensorFlow Lite (ai-edge-litert 2.3.0): anchors of both grids, all kinds of outputs."""
    logits, values = networks.palms(pattern(networks.PALM_SIDE))
    np.testing.assert_allclose(logits[0, [0, 501, 1151, 1152, 2015]], PALM_LOGITS, atol=2e-3)
    np.testing.assert_allclose(values[0, [501, 2015], ::5], PALM_VALUES, atol=2e-3)
    positions, presence, right = networks.landmarks(pattern(networks.LANDMARK_SIDE))
    np.testing.assert_allclose(positions[0, ::10], LANDMARKS, atol=2e-3)
    np.testing.assert_allclose([presence.item(), right.item()], PRESENCE_AND_RIGHT, atol=1e-4)


@pytest.mark.parametrize(("side", "kernel", "stride"), [(6, 5, 2), (6, 3, 2), (5, 3, 1), (4, 5, 1), (4, 1, 1)])
def test_a_convolution_is_padded_like_tensorflows(side: int, kernel: int, stride: int) -> None:
    """TensorFlow's rule: max((ceil(n / s) - 1) s + k - n, 0) zeros, the smaller half before the image."""
    x = torch.rand(1, 1, side, side + 2)
    layer = networks.Layer(torch.rand(1, 1, kernel, kernel), torch.rand(1), None)
    output = networks.convolve(x, layer, stride)[0, 0].numpy()
    expected = np.full((-(-side // stride), -(-(side + 2) // stride)), layer.bias.item())
    before = [max((m - 1) * stride + kernel - n, 0) // 2 for m, n in zip(expected.shape, x.shape[2:], strict=True)]
    for i, j in np.ndindex(expected.shape):
        for k, m in np.ndindex(kernel, kernel):
            row, column = i * stride + k - before[0], j * stride + m - before[1]
            if 0 <= row < side and 0 <= column < side + 2:
                expected[i, j] += x[0, 0, row, column].item() * layer.weight[0, 0, k, m].item()
    np.testing.assert_allclose(output, expected, atol=1e-5)
