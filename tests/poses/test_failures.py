"""Captures without observable rotation are rated "bad"; single faulty masks do not prevent estimation."""

import math
from dataclasses import replace

import pytest
import torch

from tests.lopsided import Tumble, truth, tumbling
from tests.poses.sfm.test_stage import QUICK
from tumble import matching
from tumble.engine.loop import drive
from tumble.evaluation import metrics
from tumble.maths.se3 import SE3, SO3
from tumble.poses.frame_pairs import neighbours
from tumble.poses.result import PoseResult
from tumble.poses.sfm import stage
from tumble.scene.camera import Camera
from tumble.scene.capture import BACKGROUND, OBJECT, Capture
from tumble.scene.match import Match

SIZE, DISTANCE = 96, 4.4
pytestmark = pytest.mark.usefixtures("no_turntable")


def untextured_capture(T_cam_obj: SE3, half_height: float | None) -> Capture:
    """A grey sphere, or a can of that half height along the object's y axis, lit from above; without texture.

    All frames of the sphere are the same, and only the first one is drawn.
    """
    camera = Camera.from_fov(math.radians(30), SIZE, SIZE)
    directions = torch.nn.functional.normalize(camera.directions().double(), dim=-1).flatten(0, 1)
    images, masks = [], []
    n = len(T_cam_obj.xyz)
    for k in range(1 if half_height is None else n):
        T_obj_cam = T_cam_obj[k].inverse()
        o, d = T_obj_cam.xyz, T_obj_cam.rotation @ directions
        depth = torch.linspace(DISTANCE - 1, DISTANCE + 1, 400, dtype=torch.float64)
        x = o + d[:, None] * depth[:, None]
        if half_height is None:
            inside = x.norm(dim=-1) < 0.8
        else:
            inside = (x[..., [0, 2]].norm(dim=-1) < 0.5) & (x[..., 1].abs() < half_height)
        hit, first = inside.any(1), inside.float().argmax(1)
        p = x[torch.arange(len(x)), first]
        normal = p if half_height is None else p * torch.tensor([1.0, 0.0, 1.0], dtype=torch.float64)
        if half_height is not None:
            cap = p[:, 1].abs() > half_height - 0.01
            normal = torch.where(cap[:, None], p * torch.tensor([0.0, 1.0, 0.0], dtype=torch.float64), normal)
        up = (T_cam_obj.rotation[k] @ torch.nn.functional.normalize(normal, dim=-1)) @ torch.tensor(
            [0.2, -0.8, -0.5]
        ).double()
        code = torch.where(hit, 60 + 150 * up.clamp_min(0), 0.0).reshape(SIZE, SIZE)
        images.append(code.round().to(torch.uint8)[..., None].expand(-1, -1, 3))
        masks.append(torch.where(hit, OBJECT, BACKGROUND).to(torch.uint8).reshape(SIZE, SIZE))
    names = tuple(f"{k}.png" for k in range(n))
    same = n // len(images)
    return Capture(torch.stack(images * same), torch.stack(masks * same), camera, names, "camera")


def rotating(n: int, rock: float) -> SE3:
    """Poses that rotate by ten degrees a frame about the object's y axis, which rocks in front of the camera."""
    spin = torch.arange(n, dtype=torch.float64)[:, None] * math.radians(10) * torch.tensor([0.0, 1.0, 0.0])
    phase = torch.arange(n, dtype=torch.float64) * 0.35
    tilt = rock * torch.stack([phase.sin(), 0 * phase, (0.7 * phase).cos()], -1)
    at = torch.tensor([0.0, 0.0, DISTANCE], dtype=torch.float64).expand(n, 3)
    return SE3.from_rotation(SO3.exp(tilt) @ SO3.exp(spin), at)


def estimate(capture: Capture) -> PoseResult:
    matches = matching.match_pairs(matching.views_of(capture), neighbours(len(capture), (1, 2)), "mixed")
    return drive(stage, QUICK, stage.gather(capture, matches), seed=0)


def test_an_untextured_sphere_is_bad() -> None:
    quality = estimate(untextured_capture(rotating(12, 0.0), None)).quality
    assert quality.rating == "bad"
    assert "not observable" in quality.sentence


@pytest.mark.slow
def test_rotation_about_the_axis_of_an_untextured_can_is_unobservable() -> None:
    """The axis rocks by 40 degrees, which contours show; the rotation about it is not observable."""
    T_cam_obj = rotating(16, 0.7)
    quality = estimate(untextured_capture(T_cam_obj, 0.8)).quality
    assert quality.rating == "bad"
    assert quality.sentence.startswith("Rotation about axis (")
    axis = T_cam_obj.rotation[0] @ torch.tensor([0.0, 1.0, 0.0], dtype=torch.float64)
    axis_in_image = torch.nn.functional.normalize(axis[:2], dim=0)
    # The tolerance is that of silhouettes of 96 pixels.
    assert abs(float(quality.observability.axis[:2].double() @ axis_in_image)) > 0.99


@pytest.fixture(scope="module")
def scene() -> Tumble:
    return tumbling(24, points=200)


def matches(scene: Tumble) -> list[Match]:
    rng = torch.Generator().manual_seed(0)
    return [scene.match(i, j, rng) for i, j in neighbours(len(scene.capture), (1, 2))]


def test_another_object_in_half_of_the_frames_is_bad(scene: Tumble) -> None:
    """From frame 12 on the silhouettes are those of a small box, without matches."""
    masks = scene.capture.masks.clone()
    masks[12:] = BACKGROUND
    for k in range(12, 24):
        half = 14 + 2 * (k % 3)
        masks[k, 64 - half : 64 + half, 50:78] = OBJECT
    some = [m for m in matches(scene) if m.j < 12]
    quality = drive(stage, QUICK, stage.gather(replace(scene.capture, masks=masks), some), seed=0).quality
    assert quality.rating == "bad"


def test_single_wrong_masks_do_not_affect_other_frames() -> None:
    """Two silhouettes of 16 are cut in half, together with their matches."""
    scene = tumbling(16, points=200)
    masks = scene.capture.masks.clone()
    for k in (4, 10):
        masks[k, :, 64:] = BACKGROUND
    kept = []
    for m in matches(scene):
        here = torch.ones(len(m), dtype=torch.bool)
        for k, uv in ((m.i, m.uv_i), (m.j, m.uv_j)):
            if k in (4, 10):
                here &= uv[:, 0] < 62
        kept.append(m.select(here))
    found = drive(stage, QUICK, stage.gather(replace(scene.capture, masks=masks), kept), seed=0)
    others = [k for k in range(16) if k not in (4, 10)]
    scores = metrics.rotation_scores(found.trajectory.select(others), truth(scene).select(others))
    assert scores["rotation_median_degrees"] < 2
    assert scores["rotation_below_10_percent"] > 99
