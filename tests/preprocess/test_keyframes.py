"""Which frames are kept: angles and blurs against motions and edges that are known."""

import math

import cv2
import numpy as np
import pytest

from tumble.preprocess import keyframes

RNG = np.random.default_rng(1)
DIS = cv2.DISOpticalFlow.create(cv2.DISOPTICAL_FLOW_PRESET_MEDIUM)


def ball(yaw: float, roll: float = 0.0, *, side: int = 200, radius: float = 70.0) -> tuple[np.ndarray, np.ndarray]:
    """A ball with a cloudy surface, seen along z, turned about the vertical and about the line of sight; its mask."""
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
    seen = np.asarray(cv2.remap(texture.astype(np.float32), u, v, cv2.INTER_LINEAR))
    picture = np.where(inside, seen.clip(0, 255), 90).astype(np.uint8)
    return np.repeat(picture[..., None], 3, 2), inside


@pytest.mark.parametrize(("yaw", "roll"), [(0.07, 0.0), (0.0, 0.07), (0.05, 0.05)])
def test_the_turn_of_a_ball_is_measured_about_any_axis(yaw: float, roll: float) -> None:
    """Closed form for a ball; 25 % for the perspective of a median over what has texture, and for flow."""
    (one, inside), (other, _) = ball(0.0), ball(yaw, roll)
    grays = cv2.cvtColor(one, cv2.COLOR_RGB2GRAY), cv2.cvtColor(other, cv2.COLOR_RGB2GRAY)
    assert keyframes.turn(DIS, *grays, inside, inside) == pytest.approx(math.hypot(yaw, roll), rel=0.25)


def test_a_shift_is_no_turn() -> None:
    one, inside = ball(0.0)
    shifted, moved = np.roll(one, 3, 1), np.roll(inside, 3, 1)
    grays = cv2.cvtColor(one, cv2.COLOR_RGB2GRAY), cv2.cvtColor(shifted, cv2.COLOR_RGB2GRAY)
    assert keyframes.turn(DIS, *grays, inside, moved) < 0.01


def test_turns_add_up_along_the_way() -> None:
    """There and back is twice the way; noise while it stands still adds nothing."""
    yaws = [*np.linspace(0, 0.5, 11), *np.linspace(0.5, 0, 11), *[0.0] * 20]
    balls = [ball(yaw) for yaw in yaws]
    noise = RNG.normal(0, 2, (len(balls), *balls[0][0].shape))
    pictures = np.stack([b[0] + n for b, n in zip(balls, noise, strict=True)]).clip(0, 255).astype(np.uint8)
    total = keyframes.turned(pictures, np.stack([b[1] for b in balls]))
    assert total[10] == pytest.approx(0.5, rel=0.25)
    assert total[21] == pytest.approx(1.0, rel=0.25)
    assert total[-1] - total[22] < 0.05
    assert (np.diff(total) >= 0).all()


@pytest.mark.parametrize("sigma", [1.0, 2.0, 4.0])
@pytest.mark.parametrize("contrast", [40, 160])
def test_blur_is_the_width_of_an_edge_whatever_its_contrast(sigma: float, contrast: int) -> None:
    """Gaussian edge: widths add in squares with the probe's 1 pixel; 8-bit steps cost up to 10 % at low contrast."""
    step = np.where(np.arange(80) < 40, 50.0, 50.0 + contrast)
    blurred = cv2.GaussianBlur(np.tile(step, (60, 1)), (0, 0), sigma, borderType=cv2.BORDER_REPLICATE)
    picture = np.repeat(blurred.round().astype(np.uint8)[..., None], 3, 2)
    found = keyframes.blur(keyframes.edges(picture), np.ones((60, 80), bool))
    assert found == pytest.approx(math.hypot(sigma, 1), rel=0.12)


def test_no_edges_are_infinitely_blurred() -> None:
    energy = keyframes.edges(np.full((20, 20, 3), 90, np.uint8))
    assert keyframes.blur(energy, np.ones((20, 20), bool)) == math.inf
    assert keyframes.blur(energy, np.zeros((20, 20), bool)) == math.inf


def test_the_sharpest_frame_of_every_window_is_kept_and_steps_stay_within_bounds() -> None:
    total = np.linspace(0, math.radians(360), 721)
    blurs = RNG.uniform(1, 3, 721)
    kept = keyframes.chosen(total, blurs, np.ones(721, bool), 100)
    steps = np.degrees(np.diff(total[kept]))
    assert len(kept) == 46
    # Eight degrees, each frame moved by a quarter window at most.
    assert steps.min() >= 4
    assert steps.max() <= 12.1
    assert blurs[kept].mean() < 1.3
    assert keyframes.largest_step(total, kept) == pytest.approx(math.radians(steps.max()))


def test_unusable_frames_are_never_kept_and_few_frames_spread_wider() -> None:
    total = np.linspace(0, math.radians(360), 361)
    usable = np.arange(361) % 7 != 0
    kept = keyframes.chosen(total, np.ones(361), usable, 10)
    assert 8 <= len(kept) <= 10
    assert usable[kept].all()
    assert keyframes.chosen(total, np.ones(361), np.zeros(361, bool), 10) == []


def test_a_film_of_few_frames_keeps_them_all() -> None:
    """48 frames 5 to 12 degrees apart, two of whose turns flow hardly saw: windows of 8 degrees would drop some."""
    steps = RNG.uniform(5, 12, 47)
    steps[[20, 30]] = 1
    total = np.radians(np.concatenate([[0], steps.cumsum()]))
    usable = np.arange(48) != 40
    assert keyframes.chosen(total, RNG.uniform(1, 3, 48), usable, 96) == np.nonzero(usable)[0].tolist()


def test_an_object_that_does_not_turn_gives_one_frame() -> None:
    assert len(keyframes.chosen(np.zeros(30), np.ones(30), np.ones(30, bool), 10)) == 1
