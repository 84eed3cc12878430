"""What several tests of matchers share."""

import itertools

import pytest
import torch

from tumble import matching
from tumble.io import weights
from tumble.io.plugins import load_plugin, plugin_names

NOT_INSTALLED = {"roma": "needs an installation of romav2", "mast3r": "needs an installation of mast3r"}


def skip_unless_usable(name: str) -> None:
    """Skip the test of a matcher that cannot run here."""
    if name in NOT_INSTALLED:
        pytest.skip(f"{name} {NOT_INSTALLED[name]}")
    if name in weights.SOURCES and not weights.is_downloaded(name):
        pytest.skip(f"{name} needs its weights: tumble weights get {name}")


@pytest.fixture(params=plugin_names("matching"))
def matcher(request: pytest.FixtureRequest) -> matching.Matcher:
    """Every matcher that can run here."""
    skip_unless_usable(request.param)
    return load_plugin("matching", request.param).load("cpu")


def xfeat_weights() -> dict[str, torch.Tensor]:
    """Random weights with the names and shapes of XFeat."""
    rng = torch.Generator().manual_seed(3)
    widths = {"block1": [1, 4, 8, 8, 24], "block2": [24, 24, 24], "block3": [24, 64, 64, 64]}
    widths |= {"block4": [64] * 4, "block5": [64, 128, 128, 128, 64], "block_fusion": [64] * 3}
    widths |= {"heatmap_head": [64] * 3, "keypoint_head": [64] * 4}
    pointwise = {"block3.2", "block5.3"} | {f"{h}.{k}" for h in ("heatmap_head", "keypoint_head") for k in range(3)}
    p: dict[str, torch.Tensor] = {}
    for name, w in widths.items():
        for k, (into, out) in enumerate(itertools.pairwise(w)):
            side = 1 if f"{name}.{k}" in pointwise else 3
            p[f"{name}.{k}.layer.0.weight"] = torch.randn(out, into, side, side, generator=rng) / (into * side) ** 0.5
            p[f"{name}.{k}.layer.1.running_mean"] = torch.zeros(out)
            p[f"{name}.{k}.layer.1.running_var"] = torch.ones(out)
    for name, out, into in (("skip1.1", 24, 1), ("block_fusion.2", 64, 64), ("heatmap_head.2", 1, 64)):
        p[f"{name}.weight"], p[f"{name}.bias"] = torch.randn(out, into, 1, 1, generator=rng), torch.zeros(out)
    p["keypoint_head.3.weight"], p["keypoint_head.3.bias"] = torch.randn(65, 64, 1, 1, generator=rng), torch.zeros(65)
    return p
