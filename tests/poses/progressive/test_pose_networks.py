"""Pose parametrisations: two pose sources, and the motion that their outputs stand for."""

import math

import pytest
import torch
from torch.nn.functional import pad

from tumble.engine import optim
from tumble.maths.se3 import SE3, SO3, angle_between
from tumble.poses.progressive import pose_networks
from tumble.poses.progressive.pose_networks import PoseSource
from tumble.scene.camera import Camera


def source(kind: str, n: int = 5, out: int = 6) -> PoseSource:
    rng = torch.Generator().manual_seed(0)
    if kind == "vectors":
        return pose_networks.vectors(n, out)
    return pose_networks.frame_mlps(n, out, rng)


KINDS = ["vectors", "frame_mlps"]


def rates(kind: str) -> dict[str, float]:
    return {"": 1e-2} | ({"codes": 0.0} if kind == "frame_mlps" else {})


@pytest.mark.parametrize("kind", KINDS)
def test_all_sources_start_near_zero_and_fit_any_target(kind: str) -> None:
    net = optim.leaves(source(kind))
    frames = [4, 0, 2]
    assert pose_networks.raw_outputs(net, frames).shape == (3, 6)
    # Last layers of standard deviation 0.01 over 64 units of size < 1: below 0.1.
    assert pose_networks.raw_outputs(net, frames).abs().max() < 0.1
    optimizer = optim.adam(net, rates(kind))
    target = 0.3 * torch.randn(3, 6, generator=torch.Generator().manual_seed(1))
    for step in range(300):
        optim.descend((pose_networks.raw_outputs(net, frames) - target).square().sum(), optimizer, step=step)
    assert (pose_networks.raw_outputs(net, frames) - target).abs().max() < 0.02


@pytest.mark.parametrize("kind", KINDS)
def test_frames_without_gradient_do_not_move(kind: str) -> None:
    """Also once they have momentum, with which Adam would otherwise move them."""
    net = optim.leaves(source(kind))
    optimizer = optim.adam(net, rates(kind))
    optim.descend((pose_networks.raw_outputs(net, [0, 1]) - 1).square().sum(), optimizer, step=0)
    before = pose_networks.raw_outputs(net, [0, 1, 2]).detach().clone()
    optim.descend((pose_networks.raw_outputs(net, [1]) - 1).square().sum(), optimizer, step=1)
    after = pose_networks.raw_outputs(net, [0, 1, 2]).detach()
    assert torch.equal(after[[0, 2]], before[[0, 2]])
    assert (after[1] - before[1]).abs().max() > 1e-4


def test_codes_are_unit_vectors_and_differ_between_frames() -> None:
    net = source("frame_mlps", n=40)
    assert isinstance(net, pose_networks.FrameMlps)
    assert torch.allclose(net.codes.norm(dim=-1), torch.ones(40), atol=1e-5)
    other = (net.codes[1:] @ net.codes[1:].T).fill_diagonal_(0)
    # Frame 0 has phase 0; others are random directions of 256 numbers, whose cosines have sigma 1/sqrt(128); 5 sigma.
    assert other.abs().max() < 5 / math.sqrt(128)


def test_a_frame_mlp_equals_its_layers_written_out() -> None:
    net = source("frame_mlps", out=4)
    assert isinstance(net, pose_networks.FrameMlps)
    weights, x = net.values["3"], net.codes[3]
    first, rest = weights[: 64 * 257], weights[64 * 257 :]
    second, last = rest[: 64 * 65], rest[64 * 65 :]
    h = torch.nn.functional.gelu(first[: 64 * 256].reshape(64, 256) @ x + first[64 * 256 :])
    h = torch.nn.functional.gelu(second[: 64 * 64].reshape(64, 64) @ h + second[64 * 64 :])
    expected = last[: 4 * 64].reshape(4, 64) @ h + last[4 * 64 :]
    assert torch.allclose(pose_networks.raw_outputs(net, [3])[0], expected, atol=1e-6)


def test_an_orbit_keeps_the_projection_of_the_centre() -> None:
    """Without a shift the projection of the object's centre is constant; a shift translates the object."""
    rng = torch.Generator().manual_seed(2)
    camera = Camera.from_fov(0.5, 100, 120)
    base = SE3(SO3.exp(torch.randn(3, generator=rng)).wxyz, torch.tensor([0.3, -0.2, 4.0]))
    raw = 0.2 * torch.randn(20, 6, generator=rng) * torch.tensor([1.0, 1, 1, 1, 0, 0])
    moved = pose_networks.orbit(base, raw)
    assert torch.allclose(camera.project(moved.xyz), camera.project(base.xyz).expand(20, 2), atol=1e-4)
    assert torch.allclose(moved.xyz[:, 2], 4.0 * (1 + raw[:, 3]))
    angle = angle_between(moved.rotation, base.rotation)
    assert torch.allclose(angle, math.pi * raw[:, :3].norm(dim=-1), atol=1e-5)
    shifted = pose_networks.orbit(base, raw + torch.tensor([0.0, 0, 0, 0, 0.05, -0.03]))
    assert torch.allclose(shifted.xyz - moved.xyz, torch.tensor([0.05, -0.03, 0.0]).expand(20, 3), atol=1e-6)
    assert torch.equal(shifted.wxyz, moved.wxyz)


def test_an_orbit_equals_the_camera_motion_of_fmov() -> None:
    """`T_obj_cam = [Exp(pi rho) | 0] @ [R | s c]`, computed with matrices."""
    rng = torch.Generator().manual_seed(3)
    base = SE3(SO3.exp(torch.randn(3, generator=rng)).wxyz, torch.tensor([0.0, 0.0, 5.0])).inverse()
    raw = pad(0.3 * torch.randn(4, generator=rng), (0, 2))
    scaled = base.matrix()
    scaled[:3, 3] *= 1 + raw[3]
    left = torch.eye(4)
    left[:3, :3] = torch.linalg.matrix_exp(
        math.pi * torch.tensor([[0, -raw[2], raw[1]], [raw[2], 0, -raw[0]], [-raw[1], raw[0], 0]])
    )
    T_cam_obj = pose_networks.orbit(base.inverse(), raw)
    assert torch.allclose(T_cam_obj.inverse().matrix(), left @ scaled, atol=1e-5)
