"""The network that corrects poses in stages 2 and 3."""

import pytest
import torch

from tumble.engine import optim
from tumble.inverse_rendering import pose_network, refine


def network(n: int = 5) -> dict[str, torch.Tensor]:
    return pose_network.initial(n, torch.zeros(1), torch.Generator().manual_seed(0))


def test_a_new_network_corrects_nothing() -> None:
    moved = pose_network.correction(torch.ones(5, 6), network(), slice(None))
    assert torch.equal(moved.matrix(), torch.eye(4).expand(5, 4, 4))


def test_without_a_network_the_tangents_count() -> None:
    poses = 0.1 * torch.randn(5, 6, generator=torch.Generator().manual_seed(0))
    one, all_ = pose_network.correction(poses, {}, 3), pose_network.correction(poses, {}, slice(None))
    assert torch.allclose(one.log(), poses[3], atol=1e-6)
    assert torch.allclose(all_.matrix()[3], one.matrix())


def test_a_network_fits_any_correction_of_every_frame() -> None:
    net = optim.leaves(network())
    optimizer = optim.adam(net, {"": 1e-2})
    target = 0.3 * torch.randn(5, 6, generator=torch.Generator().manual_seed(1))
    for step in range(300):
        optim.descend((pose_network.tangents(net, slice(None)) - target).square().sum(), optimizer, step=step)
    assert (pose_network.tangents(net, slice(None)) - target).abs().max() < 0.02
    assert torch.equal(pose_network.tangents(net, 2), pose_network.tangents(net, slice(2, 3))[0])


def test_a_network_is_not_combined_with_alignment() -> None:
    with pytest.raises(ValueError, match="set realignments to 0"):
        refine.Config(pose_model="network", realignments=4)
