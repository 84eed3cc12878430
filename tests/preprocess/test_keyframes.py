"""Keyframe selection: rotations and blurs are measured on known motions and edges."""

import math

import cv2
import numpy as np
import pytest

from tumble.preprocess import keyframes

RNG = np.random.default_rng(1)
DIS = cv2.DISOpticalFlow.create(cv2.DISOPTICAL_FLOW_PRESET_MEDIUM)


def sphere(yaw: float, roll: float = 0.0, *, side: int = 200, radius: float = 70.0) -> tuple[np.ndarray, np.ndarray]:
    """Image and mask of a sphere with cloudy texture, rotated about the vertical and the optical axis."""
    rng = np.random.default_rng(5)
    clouds = [cv2.GaussianBlur(rng.standard_normal((256, 512)), (0, 0), s) for s in (3, 6)]
    texture = 128 + 35 * sum(c / c.std() for c in clouds)
    x, y = np.meshgrid(np.arange(side) + 0.5 - side / 2, np.arange(side) + 0.5 - side / 2)
    x, y = x / radius, y / radius
    inside = x * x + y * y < 1
    x, y = x * math.cos(roll) + y * math.sin(roll), y * math.cos(roll) - x * math.sin(roll)
    z = np.sqrt(np.maximum(1 - x * x - y * y, 0))
    u = (np.arctan2(x, z) - yaw) / (2 * np.pi) * 512 + 256
    v = (np.arcsin(np.clip(y, -1, 1)) / np.pi + 0.5) * 255
    u, v = u.astype(np.float32), v.astype(np.float32)
    shaded = np.asarray(cv2.remap(texture.astype(np.float32), u, v, cv2.INTER_LINEAR))
    image = np.where(inside, shaded.clip(0, 255), 90).astype(np.uint8)
    return np.repeat(image[..., None], 3, 2), inside


@pytest.mark.parametrize(("yaw", "roll"), [(0.07, 0.0), (-0.06, 0.0), (0.0, 0.07), (0.05, 0.05)])
def test_the_rotation_of_a_sphere_is_measured_about_any_axis(yaw: float, roll: float) -> None:
    """Closed form for a sphere; 25 % tolerance for the distribution of texture and for errors of flow.

    Yaw moves points in front of the sphere to the right: x is right, y down, z away, so it is about -y.
    """
    (a, inside), (b, _) = sphere(0.0), sphere(yaw, roll)
    for shift in (0, 2):
        grays = cv2.cvtColor(a, cv2.COLOR_RGB2GRAY), cv2.cvtColor(np.roll(b, shift, 1), cv2.COLOR_RGB2GRAY)
        found = keyframes.textured_flow(DIS, *grays, inside, np.roll(inside, shift, 1))
        assert found is not None
        assert found.fitted_rotation() == pytest.approx([0, -yaw, roll], abs=0.015)
        assert shift or found.angle == pytest.approx(math.hypot(yaw, roll), rel=0.25)


def test_a_translation_is_not_a_rotation() -> None:
    image, inside = sphere(0.0)
    shifted, shifted_mask = np.roll(image, 3, 1), np.roll(inside, 3, 1)
    grays = cv2.cvtColor(image, cv2.COLOR_RGB2GRAY), cv2.cvtColor(shifted, cv2.COLOR_RGB2GRAY)
    found = keyframes.textured_flow(DIS, *grays, inside, shifted_mask)
    assert found is not None
    assert found.angle < 0.01
    assert found.fitted_rotation() == pytest.approx([0, 0, 0], abs=0.01)


def test_what_comes_in_front_of_an_object_at_rest_does_not_turn_it() -> None:
    """A hand covers more and more of it, so that the centre of what is seen moves."""
    image, inside = sphere(0.0)
    images = (np.repeat(image[None], 20, 0) + RNG.normal(0, 2, (20, *image.shape))).clip(0, 255).astype(np.uint8)
    seen = np.stack([inside & (np.arange(200) > 30 + 4 * i) for i in range(20)])
    images[~seen] = 180
    path, widest = keyframes.measured_rotation(images, seen)
    assert path[-1] < 0.1
    assert widest < 0.1


def test_rotations_add_up_along_the_path() -> None:
    """Back and forth is twice the angle; noise on a static object adds nothing."""
    yaws = [*np.linspace(0, 0.5, 11), *np.linspace(0.5, 0, 11), *[0.0] * 20]
    spheres = [sphere(yaw) for yaw in yaws]
    noise = RNG.normal(0, 2, (len(spheres), *spheres[0][0].shape))
    images = np.stack([b[0] + n for b, n in zip(spheres, noise, strict=True)]).clip(0, 255).astype(np.uint8)
    total, _ = keyframes.measured_rotation(images, np.stack([b[1] for b in spheres]))
    assert total[10] == pytest.approx(0.5, rel=0.25)
    assert total[21] == pytest.approx(1.0, rel=0.25)
    assert total[-1] - total[22] < 0.05
    assert (np.diff(total) >= 0).all()


def test_an_object_that_is_turned_to_and_fro_does_not_come_round() -> None:
    """Three times 0.5 radians and back."""
    there = [*np.linspace(0, 0.5, 9)[:-1], *np.linspace(0.5, 0, 9)[:-1]]
    spheres = [sphere(yaw) for yaw in [*there, *there, *there, 0.0]]
    images, inside = (np.stack(each) for each in zip(*spheres, strict=True))
    path, widest = keyframes.measured_rotation(images, inside)
    assert widest == pytest.approx(0.5, rel=0.3)
    assert path[-1] == pytest.approx(3.0, rel=0.25)


def test_an_object_that_goes_on_turning_comes_round() -> None:
    spheres = [sphere(yaw) for yaw in np.linspace(0, 2.4, 41)]
    images, inside = (np.stack(each) for each in zip(*spheres, strict=True))
    assert keyframes.measured_rotation(images, inside)[1] == pytest.approx(2.4, rel=0.25)
    assert keyframes.measured_rotation(np.full_like(images, 90), inside)[1] == math.pi, "not measured"


def test_a_frame_without_texture_does_not_end_the_rotation() -> None:
    """The hand of the first frame hides the texture; that frame counts as an average one."""
    spheres = [sphere(yaw) for yaw in np.linspace(0, 0.6, 13)]
    images, inside = np.stack([each[0] for each in spheres]), np.stack([each[1] for each in spheres])
    images[0] = 90
    total, _ = keyframes.measured_rotation(images, inside)
    assert total[-1] == pytest.approx(0.6, rel=0.25)


@pytest.mark.parametrize("sigma", [1.0, 2.0, 4.0])
@pytest.mark.parametrize("contrast", [40, 160])
def test_edge_blur_is_the_width_of_an_edge_at_any_contrast(sigma: float, contrast: int) -> None:
    """Variances of the edge and the probe add up; 8-bit steps cost up to 10 % at low contrast."""
    step = np.where(np.arange(80) < 40, 50.0, 50.0 + contrast)
    blurred = cv2.GaussianBlur(np.tile(step, (60, 1)), (0, 0), sigma, borderType=cv2.BORDER_REPLICATE)
    image = np.repeat(blurred.round().astype(np.uint8)[..., None], 3, 2)
    blur = keyframes.edge_blur(keyframes.edge_energy(image), np.ones((60, 80), bool))
    assert blur == pytest.approx(math.hypot(sigma, 1), rel=0.12)


def test_a_region_without_edges_has_infinite_blur() -> None:
    energy = keyframes.edge_energy(np.full((20, 20, 3), 90, np.uint8))
    assert keyframes.edge_blur(energy, np.ones((20, 20), bool)) == math.inf
    assert keyframes.edge_blur(energy, np.zeros((20, 20), bool)) == math.inf


def test_the_sharpest_frame_of_every_window_is_selected_and_steps_are_limited() -> None:
    total = np.linspace(0, math.radians(360), 721)
    blurs = RNG.uniform(1, 3, 721)
    kept = keyframes.select_keyframes(total, blurs, np.ones(721, bool), 100)
    steps = np.degrees(np.diff(total[kept]))
    assert len(kept) == 91
    # Four degrees; each frame is at most a quarter of a window off its middle.
    assert steps.min() >= 1.9
    assert steps.max() <= 6.1
    assert blurs[kept].mean() < 1.5
    assert keyframes.largest_step(total, kept) == pytest.approx(math.radians(steps.max()))


def test_unusable_frames_are_never_selected_and_few_frames_are_spread_wider() -> None:
    total = np.linspace(0, math.radians(360), 361)
    usable = np.arange(361) % 7 != 0
    kept = keyframes.select_keyframes(total, np.ones(361), usable, 10)
    assert 8 <= len(kept) <= 10
    assert usable[kept].all()
    assert keyframes.select_keyframes(total, np.ones(361), np.zeros(361, bool), 10) == []


def test_all_frames_of_a_short_video_are_selected() -> None:
    """48 frames 5 to 12 degrees apart, two of them underestimated: windows of 4 degrees would drop some."""
    steps = RNG.uniform(5, 12, 47)
    steps[[20, 30]] = 0.5
    total = np.radians(np.concatenate([[0], steps.cumsum()]))
    usable = np.arange(48) != 40
    assert keyframes.select_keyframes(total, RNG.uniform(1, 3, 48), usable, 96) == np.nonzero(usable)[0].tolist()


def test_a_fast_part_does_not_cost_frames_of_the_rest() -> None:
    """Half of the rotation lies between two frames, as it seems where a hand changes its grip."""
    total = np.radians(np.concatenate([np.arange(100) * 2.0, 400 + np.arange(100) * 2.0]))
    kept = keyframes.select_keyframes(total, np.ones(200), np.ones(200, bool), 100)
    assert len(kept) == pytest.approx(100, abs=4)
    steps = np.degrees(np.diff(total[kept]))
    assert np.sort(steps)[-2] <= 6.1


def test_of_a_video_with_a_few_frames_too_many_all_others_are_selected() -> None:
    """A frame close to its neighbours and a blurred one are left out."""
    steps, blurs = RNG.uniform(3, 9, 146), np.ones(146)
    steps[[50, 51]], blurs[90] = 0.5, 40.0
    total = np.radians(steps.cumsum())
    kept = keyframes.select_keyframes(total, blurs, np.ones(146, bool), 144)
    assert kept == [i for i in range(146) if i not in (50, 90)]


def test_one_frame_of_an_object_that_does_not_rotate_is_selected() -> None:
    assert len(keyframes.select_keyframes(np.zeros(30), np.ones(30), np.ones(30, bool), 10)) == 1
