"""Albedo solved from photographs of a textured quad that are computed analytically, without our renderer."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch

from tumble.export import photo_texture
from tumble.export.atlas import UnwrappedMesh
from tumble.export.bake import Texels, Textures, locate_texels
from tumble.maths.se3 import SE3, SO3
from tumble.rendering import lit_frames
from tumble.rendering.lit_frames import LitFrame
from tumble.scene.camera import Camera
from tumble.scene.capture import BACKGROUND, OBJECT, UNKNOWN

SIDE = 48
"""Side of the photographs [pixels]."""
CAMERA = Camera.from_fov(math.radians(24), SIDE, SIDE)
HIGHLIGHT = np.array([0.02, 0.03, 0.01], np.float32)


def painted(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Linear albedo of the plane z = 0: different stripes in each channel and a slope, without any symmetry."""
    stripes = [0.12 * np.sin(17 * x + 3 * y), 0.1 * np.sin(13 * y - 5 * x + 1), 0.1 * np.sin(11 * (x + y))]
    return np.stack(stripes, -1) + 0.4 + 0.1 * x[..., None] * np.array([1, -1, 0.5])


def quad() -> UnwrappedMesh:
    """The square |x|, |y| < 0.7 of z = 0, seen from +z, over three quarters of the texture."""
    corners = np.array([[-0.7, -0.7, 0], [0.7, -0.7, 0], [0.7, 0.7, 0], [-0.7, 0.7, 0]])
    uv = np.array([[0.1, 0.85], [0.85, 0.85], [0.85, 0.1], [0.1, 0.1]])
    normals, tangents = np.tile([0.0, 0, 1], (4, 1)), np.tile([1.0, 0, 0, 1], (4, 1))
    return UnwrappedMesh(corners, normals, tangents, uv, np.array([[0, 1, 2], [0, 2, 3]]))


def pose(tilt: float, turn: float) -> SE3:
    """A camera at a distance of 4 that looks at the quad's centre, tilted away from its normal [radians]."""
    R = SO3.exp(torch.tensor([math.pi, 0.0, 0.0])) @ SO3.exp(torch.tensor([tilt, turn, 0.2 * turn]))
    return SE3(R.wxyz, torch.tensor([0.0, 0.0, 4.0]))


def frame(
    T_cam_obj: SE3, number: int, *, height: float = 0.0, shift: tuple[float, float] = (0, 0), hand: bool = False
) -> LitFrame:
    """Photograph of the painted plane z = `height`, the mean over 6 x 6 rays per pixel.

    Args:
        shift: Position in the photograph minus that in the view [pixels].
        hand: Whether the mask is unknown where x > 0.
    """
    fine = 6
    places = (np.arange(SIDE * fine) + 0.5) / fine
    uv = np.stack(np.meshgrid(places - shift[0], places - shift[1]), -1)
    fx, fy, cx, cy = CAMERA.fx_fy_cx_cy.double().numpy()
    ray = np.stack([(uv[..., 0] - cx) / fx, (uv[..., 1] - cy) / fy, np.ones(uv.shape[:2])], -1)
    R, centre = T_cam_obj.rotation.matrix().double().numpy(), T_cam_obj.inverse().xyz.double().numpy()
    ray = ray @ R
    x, y, _ = np.moveaxis(centre + ray * ((height - centre[2]) / ray[..., 2])[..., None], -1, 0)
    albedo = painted(x, y).reshape(SIDE, fine, SIDE, fine, 3).mean((1, 3))
    light = np.array([1.1, 0.9, 0.8]) * (0.8 + 0.3 * math.sin(number))
    inside = (np.abs(np.stack([x, y])) < 0.62).all(0).reshape(SIDE, fine, SIDE, fine).all((1, 3))
    shape = (SIDE, SIDE, 3)
    diffuse, specular = (np.broadcast_to(v, shape).astype(np.float32) for v in (light, HIGHLIGHT))
    shown = (np.abs(np.stack([x, y])) < 0.7).all(0).reshape(SIDE, fine, SIDE, fine).mean((1, 3)) > 0.5
    hidden = hand & (x.reshape(SIDE, fine, SIDE, fine).mean((1, 3)) > 0)
    mask = np.where(shown, np.where(hidden, UNKNOWN, OBJECT), BACKGROUND).astype(np.uint8)
    photo = (albedo * diffuse + specular).astype(np.float32)
    return LitFrame(mask, T_cam_obj, CAMERA, photo, inside, diffuse, specular)


POSES = [pose(tilt, turn) for tilt in (-0.7, 0.05, 0.6) for turn in (-0.6, 0.0, 0.7)]
FRAMES = [frame(T, i) for i, T in enumerate(POSES)]


@pytest.fixture(scope="module")
def texels() -> Texels:
    return locate_texels(quad(), 2 * SIDE)


def truth(texels: Texels) -> np.ndarray:
    return painted(texels.points[:, 0].numpy(), texels.points[:, 1].numpy()).astype(np.float32)


def blurred(texels: Texels) -> np.ndarray:
    """What the Gaussians know: the mean colour."""
    return np.full_like(truth(texels), 0.4)


def error(albedo: np.ndarray, texels: Texels, within: float = 0.5) -> float:
    """Root mean square error of texels near the quad's centre."""
    near = (texels.points[:, :2].abs() < within).all(-1).numpy()
    return float(np.sqrt(((albedo - truth(texels))[near] ** 2).mean()))


def test_stripes_finer_than_the_baked_texture_are_found(texels: Texels) -> None:
    """The stripes are 9 pixels long: the mean over a pixel is 2 % flatter, a wrong axis or offset leaves them all."""
    albedo, _ = photo_texture.solve(blurred(texels), texels, FRAMES)
    assert error(blurred(texels), texels) > 0.08
    assert error(albedo, texels) < 0.008


def test_texels_that_no_photograph_shows_keep_the_baked_value(texels: Texels) -> None:
    hidden = (texels.points[:, :2].abs() > 0.66).any(-1).numpy()
    albedo, _ = photo_texture.solve(blurred(texels), texels, FRAMES)
    assert hidden.sum() > 300
    assert (albedo[hidden] == blurred(texels)[hidden]).all()
    backs = [replace(f, T_cam_obj=SE3(f.T_cam_obj.wxyz, -f.T_cam_obj.xyz)) for f in FRAMES]
    assert (photo_texture.solve(blurred(texels), texels, backs)[0] == blurred(texels)).all()


def test_what_a_hand_hides_continues_what_is_seen(texels: Texels) -> None:
    """A hand hides what is beyond x = 0 in all frames but one; beyond x = 0.1 are other values, and a tilted normal."""
    held = [frame(T, i, hand=i > 0) for i, T in enumerate(POSES)]
    at, side = (texels.rows.numpy(), texels.columns.numpy()), 2 * SIDE
    images = [np.zeros((side, side), np.uint8) for _ in range(3)]
    for image, seen, hidden in zip(images, (200, 150, 128), (20, 30, 200), strict=True):
        image[at] = torch.where(texels.points[:, 0] < 0.1, seen, hidden).numpy()
    before = Textures(np.dstack([images[0]] * 3), images[1], np.dstack([images[2], images[2], images[2] | 255]))
    after = photo_texture.continued(before, quad(), held)
    inner = (texels.points[:, :2].abs() < 0.6).all(-1).numpy()
    assert (after.base_color[at][inner] == 200).all()
    assert (after.roughness[at][inner] == 150).all()
    assert (after.normal[at][inner] == (128, 128, 255)).all()
    same = photo_texture.continued(before, quad(), FRAMES)
    assert (same.base_color[at][inner] == before.base_color[at][inner]).all()


def test_a_hidden_surface_is_not_painted_with_the_one_before_it(texels: Texels) -> None:
    """A copy of the quad at a distance of 0.3 behind it."""
    n = len(texels.points)
    behind = texels.points - torch.tensor([0, 0, 0.3])
    both = Texels(*(torch.cat([x, behind if x is texels.points else x]) for x in vars(texels).values()))
    baked = np.concatenate([blurred(texels)] * 2)
    albedo, _ = photo_texture.solve(baked, both, FRAMES)
    assert error(albedo[:n], texels) < 0.008
    assert error(np.where(albedo[n:] == baked[n:], truth(texels), albedo[n:]), texels) < 0.01, "only bare rims are seen"
    assert (albedo[n:] == baked[n:])[(behind[:, :2].abs() < 0.3).all(-1).numpy()].all()


def test_a_highlight_that_the_light_does_not_explain_is_an_outlier(texels: Texels) -> None:
    bright = [replace(f, photo=f.photo.copy()) for f in FRAMES]
    bright[4].photo[18:26, 20:30] += 0.5
    albedo, _ = photo_texture.solve(blurred(texels), texels, bright)
    assert error(albedo, texels) < 0.02
    linear, _ = _without_robust_loss(blurred(texels), texels, bright)
    assert error(linear, texels) > 0.03


def _without_robust_loss(*arguments: object) -> tuple[np.ndarray, float]:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(photo_texture, "HUBER", 100.0)
        return photo_texture.solve(*arguments)  # type: ignore[arg-type]


def test_a_photograph_off_by_pixels_is_registered_and_an_exact_one_left_alone(texels: Texels) -> None:
    """One frame is shifted by (1.5, -1) pixels, a sixth of the stripes; the others are exact."""
    moved = list(FRAMES)
    moved[4] = frame(POSES[4], 4, shift=(1.5, -1.0))
    start = truth(texels)
    parts = [photo_texture._equations(texels, f) for f in (moved[4], moved[3])]
    new, same = (photo_texture._registered(start, CAMERA, part) for part in parts)
    assert photo_texture._loss(new, start) < 0.1 * photo_texture._loss(parts[0], start)
    assert same is parts[1]
    assert error(photo_texture.solve(blurred(texels), texels, moved)[0], texels) < 0.011


@pytest.mark.parametrize("offset", [0.0, 0.012])
def test_the_offset_of_the_surface_is_found(offset: float) -> None:
    """A plane above the mesh by 0.012, 0.34 pixels."""
    frames = [frame(T, i, height=offset) for i, T in enumerate(POSES)]
    grey = np.full((2 * SIDE, 2 * SIDE, 3), 170, np.uint8)
    moved = photo_texture.aligned_surface(quad(), grey, frames)
    assert moved.vertices[:, 2] == pytest.approx(offset, abs=0.003)
    assert (moved.vertices[:, :2] == quad().vertices[:, :2]).all()


def test_a_faint_texture_does_not_tell_the_offset() -> None:
    """The losses of a marbled knight, whose minimum comes and goes with the noise, and those of a printed box."""
    assert photo_texture._lowest([0.02110, 0.02099, 0.02144]) is None
    assert photo_texture._lowest([0.01775, 0.01793, 0.01860]) is None
    assert photo_texture._lowest([0.04921, 0.03903, 0.04263]) == pytest.approx(0.31, abs=0.02)


def test_the_texture_keeps_what_the_baked_one_has_beyond_the_photographs() -> None:
    """A texture finer than the solved one: its own grain stays, the stripes are added; the gutter is filled."""
    rng, resolution = np.random.default_rng(0), 8 * SIDE
    grain = rng.integers(-8, 9, (resolution, resolution, 1))
    base = np.clip(170 + grain, 0, 255).astype(np.uint8).repeat(3, 2)
    new = photo_texture.solved_base_color(base, quad(), FRAMES)
    fine = locate_texels(quad(), resolution)
    at = (fine.rows.numpy(), fine.columns.numpy())
    colour = ((new[at] / 255.0 + 0.055) / 1.055) ** 2.4
    assert error(colour, fine) < 0.03
    near = (fine.points[:, :2].abs() < 0.5).all(-1).numpy()
    kept = np.corrcoef((colour - truth(fine))[near, 0], grain[at][near, 0])[0, 1]
    assert kept > 0.9


def test_unknown_and_saturated_pixels_and_borders_are_left_out() -> None:
    """A hand over the object is unknown in the mask: none of it, and nothing within two pixels, may be baked."""
    mask = np.full((40, 40), OBJECT, np.uint8)
    mask[:, :6], mask[10:15, 20:25] = BACKGROUND, UNKNOWN
    photo = np.full((40, 40, 3), 90, np.uint8)
    photo[30, 30, 1] = 255
    coverage = np.ones((40, 40), np.float32)
    coverage[:, 36:] = 0.5
    usable = lit_frames.usable_pixels(photo, mask, coverage)
    expected = np.zeros((40, 40), bool)
    expected[2:38, 8:34] = True
    expected[8:17, 18:27] = expected[30, 30] = False
    assert (usable == expected).all()


def test_a_planted_unknown_blob_is_not_baked(texels: Texels) -> None:
    """A green blob at the same place in every photograph, unknown in the masks: what it hides keeps the baked value."""
    frames = []
    for f in FRAMES:
        spot = CAMERA.project(f.T_cam_obj @ torch.tensor([[0.2, -0.1, 0.0]]))[0].int().tolist()
        mask, photo = np.full((SIDE, SIDE), OBJECT, np.uint8), f.photo.copy()
        blob = np.s_[spot[1] - 4 : spot[1] + 5, spot[0] - 4 : spot[0] + 5]
        mask[blob], photo[blob] = UNKNOWN, [0.0, 0.9, 0.0]
        seen = lit_frames.usable_pixels(np.full((SIDE, SIDE, 3), 90, np.uint8), mask, np.ones((SIDE, SIDE)))
        frames.append(replace(f, photo=photo, usable=f.usable & seen))
    albedo, _ = photo_texture.solve(blurred(texels), texels, frames)
    under = ((texels.points[:, :2] - torch.tensor([0.2, -0.1])).norm(dim=-1) < 0.05).numpy()
    assert (albedo[under] == blurred(texels)[under]).all()
    away = ((texels.points[:, :2] - torch.tensor([0.2, -0.1])).norm(dim=-1) > 0.4).numpy()
    assert np.abs(albedo - truth(texels))[away & (texels.points[:, :2].abs() < 0.5).all(-1).numpy()].max() < 0.05
