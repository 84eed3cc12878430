import torch

from tumble.maths import srgb_from_linear
from tumble.scene import BACKGROUND, OBJECT, UNKNOWN, Camera, Capture


def test_half_the_resolution() -> None:
    """Two frames of 4 x 6 pixels, with one more row and column that are left out."""
    X, U, B = OBJECT, UNKNOWN, BACKGROUND
    rows = [[X, X, X, B, B, B, X], [X, X, B, X, B, B, X], [U, U, X, U, X, X, X], [U, U, X, X, X, X, B]]
    masks = torch.tensor([[*rows, [B] * 7]] * 2, dtype=torch.uint8)
    images = torch.zeros(2, 5, 7, 3, dtype=torch.uint8)
    images[1, 2:4, 4:6, 1] = torch.tensor([[255, 0], [0, 255]], dtype=torch.uint8)
    images[:, 4], images[:, :, 6] = 200, 200
    camera = Camera(torch.tensor([8.0, 9.0, 3.5, 2.5]), 5, 7)
    capture = Capture(images, masks, camera, ("a.png", "b.png"), "camera", full_images=images)

    half = capture.halved()
    assert half.masks.tolist() == [[[X, U, B], [U, U, X]]] * 2
    mean = round(255 * float(srgb_from_linear(torch.tensor(0.5))))  # of linear radiance
    wanted = torch.zeros(2, 2, 3, 3, dtype=torch.uint8)
    wanted[1, 1, 2, 1] = mean
    assert torch.equal(half.images, wanted)
    assert half.full_images is None
    assert half.names == capture.names
    x_cam = torch.tensor([[0.3, -0.2, 2.0], [0.0, 0.1, 4.0]])
    torch.testing.assert_close(half.camera.project(x_cam), camera.project(x_cam) / 2)
