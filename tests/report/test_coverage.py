"""The advice names the face of a cube that an occluder covers in all frames, or that no frame shows."""

import math
import re
from dataclasses import replace
from functools import cache

import pytest
import torch

from tests.export.test_bake import painted
from tests.surfaces import flat
from tumble.maths.directions import fibonacci_sphere
from tumble.maths.se3 import SE3, SO3
from tumble.rendering.rasterizer import rasterize
from tumble.report import coverage, figures
from tumble.scene.asset import Asset
from tumble.scene.camera import Camera
from tumble.scene.capture import BACKGROUND, OBJECT, UNKNOWN, Capture
from tumble.scene.trajectory import Trajectory

HALF = 0.5
"""Half the side of the cube [object radius]."""
SIDE = 64
FACES = {
    "the top": (1, 1.0),
    "the bottom": (1, -1.0),
    "the front": (2, 1.0),
    "the back": (2, -1.0),
    "the right side": (0, 1.0),
    "the left side": (0, -1.0),
}
"""Axis and sign of the normal of each face, for a first camera on +z."""


@cache
def cube() -> Asset:
    """A cube seen from 30 directions all around it, the first of which is +z."""
    ticks = (torch.arange(24) + 0.5) / 12 - 1
    a, b = (HALF * x.flatten() for x in torch.meshgrid(ticks, ticks, indexing="ij"))
    points, normals = [], []
    for axis, sign in FACES.values():
        points.append(torch.stack([a, b], -1))
        others = [i for i in range(3) if i != axis]
        face = torch.full((len(a), 3), sign * HALF)
        face[:, others] = points.pop()
        points.append(face)
        normals.append(sign * torch.eye(3)[axis].expand(len(a), 3))
    shape = painted(flat(torch.cat(points), torch.cat(normals), 6 * (2 * HALF) ** 2))
    directions = torch.cat([torch.tensor([[0.0, 0.0, 1.0]]), fibonacci_sphere(29)])
    poses = torch.stack([coverage.outside_view(d)[0].matrix() for d in directions])
    camera = Camera.from_fov(math.radians(30), SIDE, SIDE)
    return replace(shape, trajectory=Trajectory(SE3.from_matrix(poses), "camera"), camera=camera)


def masks(asset: Asset, covered: str = "") -> Capture:
    """Masks of all frames; something stands before a face, and a little around it."""
    labels = []
    for i in range(len(asset.trajectory)):
        T_cam_obj = asset.trajectory.T_cam_obj[i]
        view = rasterize(asset.gaussians, asset.gamma, T_cam_obj, asset.camera, {})
        label = torch.where(view.alpha > 0.5, OBJECT, BACKGROUND).to(torch.uint8)
        if covered:
            axis, sign = FACES[covered]
            on_face = (asset.gaussians.means[view.dominant.long().clamp(min=0)][..., axis] * sign > HALF - 0.01) & (
                view.dominant >= 0
            )
            label[on_face] = UNKNOWN
        labels.append(label)
    stack = torch.stack(labels)
    names = tuple(f"{i:04}.png" for i in range(len(stack)))
    return Capture(stack[..., None].expand(-1, -1, -1, 3).contiguous(), stack, asset.camera, names, "camera")


@pytest.mark.parametrize("face", ["the bottom", "the back", "the left side"])
def test_the_covered_face_is_named(face: str) -> None:
    asset = cube()
    found = coverage.coverage_of(asset, masks(asset, face))
    told = coverage.advice(found, light_turns=True)
    said = rf"Something, such as the hand, covers {face} \((\d+)% of the surface\) in all frames: turn the object over"
    share = re.match(said, told.sentence)
    assert share is not None, told.sentence
    assert int(share[1]) == pytest.approx(100 / 6, abs=3)
    assert told.region is not None
    axis, sign = FACES[face]
    # The normals of points on the edges are between those of two faces.
    assert (found.normals[told.region][:, axis] * sign > 0.6).float().mean() > 0.95


def test_the_picture_shows_the_face_in_orange() -> None:
    asset = cube()
    found = coverage.coverage_of(asset, masks(asset, "the bottom"))
    told = coverage.advice(found, light_turns=True)
    assert told.region is not None
    assert coverage.best_direction(found, told.region)[1] < -0.8
    picture = figures.region_image(asset, found, told.region).astype(int)
    red, green, blue, alpha = picture[len(picture) // 2, picture.shape[1] // 2]
    assert alpha > 250
    assert red > green + 60 > blue + 60


def test_a_face_that_no_frame_shows_is_named() -> None:
    """All cameras are above."""
    asset = cube()
    above = torch.where(asset.trajectory.camera_positions[:, 1] > 0.5)[0]
    asset = replace(asset, trajectory=asset.trajectory.select([0, *above.tolist()]))
    told = coverage.advice(coverage.coverage_of(asset, masks(asset)), light_turns=True)
    assert re.match(r"No frame shows the bottom \(1\d% of the surface\): turn", told.sentence), told.sentence


def test_three_of_many_frames_are_enough_to_show_a_face() -> None:
    """All others are from above."""
    asset = cube()
    height = asset.trajectory.camera_positions[:, 1]
    order = height.argmax().repeat(400)
    order[[1, 2, 4]] = height.argmin()
    asset = replace(asset, trajectory=asset.trajectory.select(order.tolist()))
    found = coverage.coverage_of(asset, masks(asset))
    top, bottom = (found.normals[:, 1] * sign > 0.95 for sign in (1, -1))
    assert found.shown[top].median() == 397
    assert found.shown[bottom].median() == 3
    assert "the bottom" not in coverage.advice(found, light_turns=True).sentence


def test_without_an_occluder_all_was_seen() -> None:
    asset = cube()
    found = coverage.coverage_of(asset, masks(asset))
    told = coverage.advice(found, light_turns=True)
    assert told == coverage.Advice(told.sentence, None)
    assert told.sentence.startswith("All of the surface was seen, nearly every part in at least")
    assert "changing light" in told.sentence
    # A face of the cube is at a usable angle from a sixth to a third of all directions.
    assert 4 <= float(found.shown.median()) <= 11


def test_what_floats_beside_the_object_is_not_its_surface() -> None:
    """A small piece in a corner of the unit ball."""
    asset = cube()
    moved = asset.gaussians.means[:20] * 0.1 + torch.tensor([0.0, 0.95, 0.0])
    means = torch.cat([moved, asset.gaussians.means[20:]])
    asset = replace(asset, gaussians=replace(asset.gaussians, means=means))
    found = coverage.coverage_of(asset, masks(asset))
    assert found.points.abs().max() < HALF + coverage.CELL


def test_a_turn_about_the_line_of_sight_is_none_in_the_light_for_what_faces_the_camera() -> None:
    """The light is fixed to the camera, which the right side faces in all frames."""
    asset = cube()
    towards = coverage.outside_view(torch.tensor([1.0, 0.0, 0.0]))[0]
    rolls = SO3.exp(torch.linspace(0, 1.2, 4)[:, None] * torch.tensor([0.0, 0.0, 1.0]))
    rolled = SE3.from_rotation(rolls @ towards.rotation, towards.xyz.expand(4, 3))
    found = coverage.coverage_of(replace(asset, trajectory=Trajectory(rolled, "camera")), masks(asset))
    right = (found.normals[:, 0] > 0.95) & (found.shown == 4)
    assert right.sum() > 50
    # Normals beside an edge are up to 11 degrees off those of the side.
    assert found.turn[right].max() < 0.15


def test_a_face_that_never_turns_in_the_light_is_named() -> None:
    """Four frames differ by shifts only. That they show the other faces too is pretended."""
    asset = cube()
    still = SE3.from_matrix(torch.stack([asset.trajectory.T_cam_obj[0].matrix()] * 4))
    shifted = SE3(still.wxyz, still.xyz + torch.linspace(0, 0.3, 4)[:, None] * torch.tensor([1.0, 0, 0]))
    asset = replace(asset, trajectory=Trajectory(shifted, "camera"))
    found = coverage.coverage_of(asset, masks(asset))
    front = (found.normals[:, 2] > 0.9) & (found.shown > 0)
    assert found.turn[front].max() < 0.01
    told = coverage.advice(replace(found, shown=torch.full_like(found.shown, 4.0)), light_turns=True)
    assert "the front" in told.sentence
    assert "one attitude to the light only" in told.sentence
    fixed = coverage.advice(replace(found, shown=torch.full_like(found.shown, 4.0)), light_turns=False)
    assert fixed.sentence == "All of the surface was seen, nearly every part in at least 4 frames."
