"""Rays of the virtual camera have the colours of the input image's pixels."""

import torch

from tumble.poses.progressive import ray_sampling, virtual_camera
from tumble.scene.camera import Camera
from tumble.scene.capture import BACKGROUND, OBJECT, UNKNOWN, Capture


def capture() -> tuple[Capture, virtual_camera.Aim]:
    """One frame whose colours encode row and column; a square object off the axis, with a column of unknown pixels."""
    row, column = torch.meshgrid(torch.arange(30), torch.arange(40), indexing="ij")
    images = torch.stack([row, column, row + column], -1).to(torch.uint8)[None]
    masks = torch.full((1, 30, 40), BACKGROUND, dtype=torch.uint8)
    masks[0, 4:16, 6:18] = OBJECT
    masks[0, 4:16, 9] = UNKNOWN
    camera = Camera(torch.tensor([50.0, 60.0, 21.0, 13.0]), 30, 40)
    return Capture(images, masks, camera, ("0.png",), "camera"), virtual_camera.aim_at(masks, camera, size=32)


def project(scene: Capture, aim: virtual_camera.Aim, directions: torch.Tensor) -> torch.Tensor:
    """Positions in the frame of directions in the aim frame [pixels]."""
    return scene.camera.project(aim.R_cam_aim[0] @ directions)


def test_rays_pass_through_the_pixels_whose_colours_they_have() -> None:
    scene, aim = capture()
    pixels = ray_sampling.draw(scene, aim, 0, 200, box=(2, 3, 20, 30), block=1, rng=torch.Generator().manual_seed(0))
    uv = project(scene, aim, pixels.directions)
    column_row = (pixels.rgb * 255)[:, [1, 0]]
    assert torch.allclose(uv, column_row + 0.5, atol=1e-3)
    assert (column_row[:, 0] >= 3).all()
    assert (column_row[:, 0] < 33).all()
    assert torch.allclose(pixels.directions.norm(dim=-1), torch.ones(len(pixels)), atol=1e-6)
    known = scene.masks[0, column_row[:, 1].round().long(), column_row[:, 0].round().long()]
    assert (known != UNKNOWN).all()
    assert torch.equal(pixels.mask, (known == OBJECT).float())
    assert 150 < len(pixels) < 200


def test_a_block_is_averaged_and_its_ray_passes_through_its_centre() -> None:
    scene, aim = capture()
    pixels = ray_sampling.draw(scene, aim, 0, 100, box=(0, 0, 30, 40), block=4, rng=torch.Generator().manual_seed(0))
    # The mean of indices a, a+1, a+2, a+3 is a + 1.5; the centre of the block is at a + 2.
    assert torch.allclose(project(scene, aim, pixels.directions), (pixels.rgb * 255)[:, [1, 0]] + 0.5, atol=1e-3)
    assert set((pixels.mask * 16).unique().tolist()) <= set(range(17))
    assert 0 < float(pixels.mask.mean()) < 1


def test_ends_of_matches_count_as_object() -> None:
    scene, aim = capture()
    uv = torch.tensor([[7.2, 5.9], [0.1, 29.9], [40.0, 30.0]])
    pixels = ray_sampling.at_positions(scene, aim, 0, uv)
    assert torch.allclose(project(scene, aim, pixels.directions), uv, atol=1e-3)
    assert torch.equal((pixels.rgb * 255).round()[:, :2], torch.tensor([[5.0, 7.0], [29.0, 0.0], [29.0, 39.0]]))
    assert (pixels.mask == 1).all()


def test_the_box_of_an_empty_silhouette_is_the_whole_frame() -> None:
    scene, _ = capture()
    assert ray_sampling.silhouette_box(scene, 0, 0.05) == (2, 4, 16, 16)
    empty = Capture(scene.images, torch.zeros_like(scene.masks), scene.camera, scene.names, "camera")
    assert ray_sampling.silhouette_box(empty, 0, 0.05) == (0, 0, 30, 40)
