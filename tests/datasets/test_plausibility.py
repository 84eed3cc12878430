"""Plausibility: what no camera records is refused in a sentence, before any work; a plain capture passes silently."""

import math
import warnings
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pytest
import torch

from tests.scene.test_visual_hull import silhouettes
from tumble import pipeline, recipes
from tumble.datasets import check_plausible
from tumble.io.files import BadFile
from tumble.maths.se3 import SE3
from tumble.scene.camera import Camera
from tumble.scene.capture import BACKGROUND, OBJECT, Capture
from tumble.scene.trajectory import Trajectory


@pytest.fixture(scope="module")
def capture() -> Capture:
    """Eight silhouettes of an ellipsoid with their poses."""
    frames, trajectory = silhouettes(8, 32)
    return Capture(frames.images, frames.masks, frames.camera, frames.names, "camera", trajectory)


def moved(capture: Capture, change: Callable[[SE3], SE3]) -> Capture:
    assert capture.trajectory is not None
    return replace(capture, trajectory=Trajectory(change(capture.trajectory.T_cam_obj), capture.light))


def with_camera(capture: Capture, *intrinsics: float) -> Capture:
    return replace(capture, camera=Camera(torch.tensor(intrinsics), capture.camera.height, capture.camera.width))


def blank(capture: Capture) -> Capture:
    return replace(capture, masks=torch.full_like(capture.masks, OBJECT))


def elsewhere(capture: Capture) -> Capture:
    """The object is seen in a corner, the unit sphere in the centre."""
    masks = torch.full_like(capture.masks, BACKGROUND)
    masks[:, :2, :2] = OBJECT
    return replace(capture, masks=masks)


WRONG: dict[str, tuple[Callable[[Capture], Capture], str]] = {
    "one frame": (lambda c: c.select([0]), "has 1 frames"),
    "a focal length of 1e30": (lambda c: with_camera(c, 1e30, 1e30, 16, 16), "has focal lengths of 1e.30 and 1e.30"),
    "a focal length of 1e-30": (lambda c: with_camera(c, 1e-30, 1e-30, 16, 16), "has focal lengths of"),
    "an infinite focal length": (lambda c: with_camera(c, math.inf, math.inf, 16, 16), "has focal lengths of inf"),
    "a focal length that is not a number": (lambda c: with_camera(c, math.nan, 40, 16, 16), "has focal lengths of nan"),
    "a negative focal length": (lambda c: with_camera(c, 40.0, -40.0, 16, 16), "has focal lengths of"),
    "focal lengths that differ": (lambda c: with_camera(c, 40.0, 400.0, 16, 16), "has focal lengths of 40 and 400"),
    "a centre of 1e30": (lambda c: with_camera(c, 40, 40, 1e30, 16), "has its principal point at"),
    "white masks without poses": (lambda c: replace(blank(c), trajectory=None), "shows no background in any mask"),
    "equal poses": (lambda c: moved(c, lambda T: T[[0] * 8]), "poses that differ by only 0.00 degrees"),
    "cameras a thousand radii away": (
        lambda c: moved(c, lambda T: SE3(T.wxyz, T.xyz / T.xyz.norm(dim=-1, keepdim=True) * 1000)),
        "too far from the object: the distance of .* is 1e.03",
    ),
    "cameras 1e30 away": (lambda c: moved(c, lambda T: SE3(T.wxyz, T.xyz * 1e30)), "too far from the object"),
    "cameras in the centre": (lambda c: moved(c, lambda T: SE3(T.wxyz, T.xyz * 0)), "a camera inside the object"),
    "translations that are not numbers": (
        lambda c: moved(c, lambda T: SE3(T.wxyz, T.xyz * math.nan)),
        "a camera inside the object: the distance of .* is nan",
    ),
    "cameras that look away": (lambda c: moved(c, lambda T: SE3(T.wxyz, -T.xyz)), "masks that contradict the poses"),
    "masks of something else": (elsewhere, "masks that contradict the poses: 100%"),
}


@pytest.mark.parametrize("name", WRONG)
def test_what_no_camera_records_is_refused_before_any_work(name: str, capture: Capture) -> None:
    change, sentence = WRONG[name]
    with pytest.raises(BadFile, match=f"capture: .*{sentence}"):
        pipeline.reconstruct(change(capture), None, recipes.SMOKE)


def test_a_plain_capture_passes_without_a_word(capture: Capture) -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        check_plausible(capture, Path("x"))
        check_plausible(replace(capture, trajectory=None), Path("x"))


def test_a_capture_without_masks_or_beyond_the_unit_sphere_is_warned_of(capture: Capture) -> None:
    with pytest.warns(UserWarning, match="x: has no masks, so the background is reconstructed"):
        check_plausible(blank(capture), Path("x"))
    # Half as far away, the ellipsoid of the silhouettes is smaller than in the unit sphere; twice as far, larger.
    with pytest.warns(UserWarning, match=r"not in the unit sphere: \d+% of its pixels are outside"):
        check_plausible(moved(capture, lambda T: SE3(T.wxyz, 2.5 * T.xyz)), Path("x"))
