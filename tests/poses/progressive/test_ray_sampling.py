"""Rays of the virtual camera carry the colours of the photograph's own pixels."""

import torch

from tumble.poses.progressive import ray_sampling, virtual_camera
from tumble.scene.camera import Camera
from tumble.scene.capture import BACKGROUND, OBJECT, UNKNOWN, Capture


def capture() -> tuple[Capture, virtual_camera.Aim]:
    """One frame whose colours are its pixels' addresses; a square object off the axis, an unknown column in it."""
    row, column = torch.meshgrid(torch.arange(30), torch.arange(40), indexing="ij")
    images = torch.stack([row, column, row + column], -1).to(torch.uint8)[None]
    masks = torch.full((1, 30, 40), BACKGROUND, dtype=torch.uint8)
    masks[0, 4:16, 6:18] = OBJECT
    masks[0, 4:16, 9] = UNKNOWN
    camera = Camera(torch.tensor([50.0, 60.0, 21.0, 13.0]), 30, 40)
    return Capture(images, masks, camera, ("0.png",), "camera"), virtual_camera.aim_at(masks, camera, size=32)


def back(scene: Capture, aim: virtual_camera.Aim, directions: torch.Tensor) -> torch.Tensor:
    return scene.camera.project(aim.R_cam_aim[0] @ directions)


def test_rays_go_through_the_pixels_whose_colours_they_carry() -> None:
    scene, aim = capture()
    part = ray_sampling.draw(scene, aim, 0, 200, box=(2, 3, 20, 30), block=1, rng=torch.Generator().manual_seed(0))
    uv = back(scene, aim, part.directions)
    address = (part.rgb * 255)[:, [1, 0]]
    assert torch.allclose(uv, address + 0.5, atol=1e-3)
    assert (address[:, 0] >= 3).all()
    assert (address[:, 0] < 33).all()
    assert torch.allclose(part.directions.norm(dim=-1), torch.ones(len(part)), atol=1e-6)
    known = scene.masks[0, address[:, 1].round().long(), address[:, 0].round().long()]
    assert (known != UNKNOWN).all()
    assert torch.equal(part.mask, (known == OBJECT).float())
    assert 150 < len(part) < 200


def test_a_block_is_averaged_and_seen_through_its_middle() -> None:
    scene, aim = capture()
    part = ray_sampling.draw(scene, aim, 0, 100, box=(0, 0, 30, 40), block=4, rng=torch.Generator().manual_seed(0))
    # The mean of addresses a, a+1, a+2, a+3 is a + 1.5; the middle of the block lies at a + 2.
    assert torch.allclose(back(scene, aim, part.directions), (part.rgb * 255)[:, [1, 0]] + 0.5, atol=1e-3)
    assert set((part.mask * 16).unique().tolist()) <= set(range(17))
    assert 0 < float(part.mask.mean()) < 1


def test_ends_of_matches_count_as_object() -> None:
    scene, aim = capture()
    uv = torch.tensor([[7.2, 5.9], [0.1, 29.9], [40.0, 30.0]])
    part = ray_sampling.at(scene, aim, 0, uv)
    assert torch.allclose(back(scene, aim, part.directions), uv, atol=1e-3)
    assert torch.equal((part.rgb * 255).round()[:, :2], torch.tensor([[5.0, 7.0], [29.0, 0.0], [29.0, 39.0]]))
    assert (part.mask == 1).all()


def test_the_window_around_nothing_is_everything() -> None:
    scene, _ = capture()
    assert ray_sampling.around(scene, 0, 0.05) == (2, 4, 16, 16)
    empty = Capture(scene.images, torch.zeros_like(scene.masks), scene.camera, scene.names, "camera")
    assert ray_sampling.around(empty, 0, 0.05) == (0, 0, 30, 40)
