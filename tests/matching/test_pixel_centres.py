"""Pixel centres lie at +0.5 in every matcher, to a fraction of a pixel.

A wrong convention in one frame shifts all matches. One that both frames have in common hides in pairs that hardly
rotate: a shift c in both moves the residuals of a transformation A by (A - 1) c. So the second frame is rotated as far
as a matcher follows, or by half a turn. Images are sums of waves evaluated at pixel centres, without interpolation.

Published networks have an offset of their own (docs/experiments/constants.md, "matching"), which upright pairs, with
which they were trained, do not show. So ALIKED matches a pair that is not rotated, and networks whose weights are made
symmetric mark keypoints in a frame that is turned by half. XFeat's own matches are left out: its keypoints gather at
one column of each cell of 8 pixels, and so move less than the object does.
"""

import math
from collections.abc import Callable

import numpy as np
import pytest
import safetensors.torch
import torch
from torch import Tensor

from tests.matching.conftest import skip_unless_usable, xfeat_weights
from tumble.io.plugins import load_plugin
from tumble.matching import _window, aliked, gmflow, xfeat
from tumble.scene import BACKGROUND, OBJECT, View

HEIGHT, WIDTH, RADIUS = 400, 440, 160.0
"""Size of the frames and radius of the object [pixels]; windows of 384 pixels neither enlarge nor reduce it."""
CENTRE = np.array([223.3, 197.8])
SHIFT = np.array([7.3, -4.8])
"""Of the object's centre in the second frame [pixels]."""
SCALE = 0.85
"""Of the object in the second frame."""


def waves(positions: np.ndarray) -> np.ndarray:
    """Coloured image at positions [pixels], of random waves of 6 to 60 pixels."""
    rng = np.random.default_rng(2)
    length = np.exp(rng.uniform(math.log(6), math.log(60), 120))
    angle, phase = rng.uniform(0, 2 * math.pi, (2, 120))
    colour = rng.normal(size=(120, 3)) * length[:, None] ** 0.3
    image = np.zeros((*positions.shape[:-1], 3))
    for k, towards in enumerate(np.stack([np.cos(angle), np.sin(angle)], -1)):
        image += np.sin(2 * math.pi / length[k] * (positions @ towards) + phase[k])[..., None] * colour[k]
    return (127 + 2 * image).clip(0, 255).round().astype(np.uint8)


def view(number: int, A: np.ndarray, b: np.ndarray) -> View:
    """A round object moved by x -> A x + b."""
    pixels = np.stack(np.meshgrid(np.arange(WIDTH), np.arange(HEIGHT)), -1) + 0.5
    before = (pixels - b) @ np.linalg.inv(A).T
    mask = np.where(np.linalg.norm(before - CENTRE, axis=-1) < RADIUS, OBJECT, BACKGROUND).astype(np.uint8)
    return View(number, torch.from_numpy(waves(before)), torch.from_numpy(mask))


def similarity(degrees: float) -> tuple[np.ndarray, np.ndarray]:
    """Matrix and shift that rotate the object about its centre, which moves by SHIFT, and scale it by SCALE."""
    cosine, sine = math.cos(math.radians(degrees)), math.sin(math.radians(degrees))
    A = SCALE * np.array([[cosine, -sine], [sine, cosine]])
    return A, CENTRE - A @ CENTRE + SHIFT


@pytest.mark.parametrize(
    ("name", "degrees"),
    [("sift", 30), ("dis", 15), ("mixed", 15), ("gmflow", 15), ("aliked", 0)]
    + [("aliked_turned", degrees) for degrees in (80, 190)],
)
def test_matches_of_a_known_similarity_are_unbiased(name: str, degrees: float) -> None:
    """Half a pixel of the window would be 0.3 pixels or more in one frame, and 0.15 in both; a turn off by one 0.8."""
    skip_unless_usable(name)
    A, b = similarity(degrees)
    match = load_plugin("matching", name).load("cpu")(view(0, np.eye(2), np.zeros(2)), view(1, A, b))
    residual = match.uv_i.double().numpy() @ A.T + b - match.uv_j.double().numpy()
    inlier = np.linalg.norm(residual, axis=-1) < 2
    assert inlier.sum() > 300
    # Seen: 0.04 for flow, whose means differ by so much from image to image, and 0.01 for the others. What `OFFSET`
    # leaves of the network's offset on this texture adds up where a frame is turned over: 0.33.
    assert np.abs(residual[inlier].mean(0)).max() < (0.4 if name == "aliked_turned" else 0.1)


def test_gmflow_matches_what_its_flow_connects(monkeypatch: pytest.MonkeyPatch) -> None:
    """With the true flow between pixel centres of the windows in place of the network's."""
    A, b = similarity(15)
    views = view(0, np.eye(2), np.zeros(2)), view(1, A, b)
    windows = _window.crop_windows(*views, gmflow.SIZE)
    assert windows is not None
    centres = np.stack(np.meshgrid(*[np.arange(gmflow.SIZE) + 0.5] * 2), -1).reshape(-1, 2)

    def flow(here: _window.Window, other: _window.Window, move: Callable[[np.ndarray], np.ndarray]) -> Tensor:
        there = (move(centres / here.scale + here.corner) - other.corner) * other.scale
        return torch.from_numpy((there - centres).astype(np.float32)).T.unflatten(1, (gmflow.SIZE, gmflow.SIZE))

    i, j = windows
    both = torch.stack([flow(i, j, lambda x: x @ A.T + b), flow(j, i, lambda x: (x - b) @ np.linalg.inv(A).T)])
    monkeypatch.setattr(gmflow.weights, "load", lambda *_: {})
    monkeypatch.setattr(gmflow._gmflow, "flow", lambda *_: both)
    match = gmflow.load("cpu")(*views)
    assert len(match) > 300
    # Positions and flow in 32-bit floats.
    assert np.abs(match.uv_i.double().numpy() @ A.T + b - match.uv_j.double().numpy()).max() < 1e-3


def offset(keypoints: Callable[[View], Tensor]) -> Tensor:
    """Mean offset of a frame's keypoints [pixels]: half of that to the keypoints of the frame turned by half."""
    plain = view(0, np.eye(2), np.zeros(2))
    turned = View(0, plain.image.flip(0, 1).contiguous(), plain.mask.flip(0, 1).contiguous())
    at, back = keypoints(plain), torch.tensor([WIDTH, HEIGHT]) - keypoints(turned)
    distance = torch.cdist(at, back)
    nearest = distance.argmin(1)
    mutual = (distance.argmin(0)[nearest] == torch.arange(len(nearest))) & (distance.amin(1) < 1)
    assert mutual.sum() > 200
    return (at - back[nearest])[mutual].mean(0) / 2


def half_turn(kernel: Tensor) -> Tensor:
    """Mean of a kernel and the same turned by half."""
    return (kernel + kernel.flip(2, 3)) / 2


def test_keypoints_of_sift_have_no_offset() -> None:
    match = load_plugin("matching", "sift").load("cpu")
    # Half a pixel of the window is half a pixel of the frame. Seen: 0.002.
    assert offset(lambda seen: match(seen, View(1, seen.image, seen.mask)).uv_i).abs().max() < 0.02


def test_keypoints_of_a_symmetric_aliked_have_no_offset(monkeypatch: pytest.MonkeyPatch) -> None:
    """Without the offsets of deformable convolutions."""
    monkeypatch.setattr(aliked, "MIN_SCORE", 0.0)
    monkeypatch.setattr(aliked, "OFFSET", (0.0, 0.0))
    tensors = safetensors.torch.load_file(aliked.WEIGHTS)
    p = {name.removeprefix("aliked."): x.float() for name, x in tensors.items() if name.startswith("aliked.")}
    for name, x in p.items():
        if name.startswith("block") and ".offset_conv." in name:
            p[name] = torch.zeros_like(x)
        elif x.ndim == 4 and not name.startswith("desc_head"):
            p[name] = half_turn(x)
    # Only rounding is left; half a pixel of the window is 0.4 pixels.
    assert offset(lambda seen: aliked._extract(seen, p).uv).abs().max() < 1e-3


def test_keypoints_of_a_symmetric_xfeat_have_no_offset(monkeypatch: pytest.MonkeyPatch) -> None:
    """Random weights, equal reliability; channels of the keypoint head are the pixels of a cell, which half a turn
    reverses."""
    monkeypatch.setattr(xfeat, "MIN_SCORE", 0.0)
    p = xfeat_weights()
    p["heatmap_head.2.weight"] = torch.zeros(1, 64, 1, 1)
    for k in range(3):
        name = f"keypoint_head.{k}.layer.0.weight"
        p[name] = (p[name] + p[name].flip(0, 1)) / 2
    last = p["keypoint_head.3.weight"]
    p["keypoint_head.3.weight"] = torch.cat([last[:-1] + last[:-1].flip(0, 1), last[-1:] + last[-1:].flip(1)]) / 2
    assert offset(lambda seen: xfeat._extract(seen, p)[0]).abs().max() < 1e-3
