"""Symmetric turns of a cube whose every pixel is known in closed form, behind a gap of frames without the object."""

import math
from dataclasses import replace

import pytest
import torch
from torch import Tensor

from tumble.engine import State
from tumble.maths import SE3, SO3, angle_between, mean_rotation
from tumble.poses.result import MAX_USABLE_UNCERTAINTY
from tumble.poses.sfm import stage, symmetry
from tumble.poses.sfm.observations import Inputs
from tumble.poses.sfm.relocalization import longest_smooth_sequence
from tumble.scene import BACKGROUND, OBJECT, Camera, Capture, Trajectory
from tumble.synthetic import trajectories

SIDE = 0.5
"""Half the length of an edge; the corners lie within the unit sphere."""
FRAMES, DISTANCE, SIZE, TILES = 40, 4.0, 96, 4
LOST = slice(18, 24)
CAMERA = Camera.from_fov(math.radians(26), SIZE, SIZE)
LIGHT = torch.nn.functional.normalize(torch.tensor([-0.5, -0.6, -1.0]), dim=0)
"""Direction to the light, camera frame."""
QUARTER = SO3.exp(torch.tensor([0.0, math.pi / 2, 0.0]))
"""A turn that leaves the cube as it is."""


def intersect(T_cam_obj: SE3) -> tuple[Tensor, Tensor, Tensor]:
    """Where pixel rays enter the box of half sides `SIDE`, object frame, the face there, and whether they do."""
    T_obj_cam = T_cam_obj.inverse()
    rays = T_obj_cam.rotation @ CAMERA.directions()
    ends = (torch.stack([-torch.ones(3), torch.ones(3)]) * SIDE - T_obj_cam.xyz)[:, None, None] / rays
    enter, leave = ends.amin(0).max(-1), ends.amax(0).amin(-1)
    x = T_obj_cam.xyz + enter.values[..., None] * rays
    axis = torch.nn.functional.one_hot(enter.indices, 3)
    return x, axis * x.sign(), enter.values < leave


def film(painted: bool, alike: float = 0.0) -> tuple[Capture, Trajectory]:
    """A cube that a hand tumbles, with tiles of random colours or of one colour.

    Args:
        alike: How much of the difference between the tiles and those after a half turn about y is taken away.
    """
    rng = torch.Generator().manual_seed(0)
    T = trajectories.handheld(FRAMES, DISTANCE, seed=0)
    T = SE3(T.wxyz.float(), T.xyz.float())
    colours = 0.1 + 0.8 * torch.rand(6, TILES, TILES, 3, generator=rng) if painted else torch.tensor([0.3, 0.5, 0.7])
    if alike:
        # Faces are -x, x, -y, y, -z, z; the tiles of an axis are counted along the next axis and the one after it.
        opposite = torch.cat([colours[:2].flip(0, 2), colours[2:4].flip(1, 2), colours[4:].flip(0, 1)])
        colours = colours + alike * (opposite - colours) / 2
    images, masks = [], []
    for i in range(FRAMES):
        x, normal, hit = intersect(T[i])
        axis = normal.abs().argmax(-1)
        face = 2 * axis + (normal.sum(-1) > 0)
        tile = ((x / SIDE + 1) / 2 * TILES).floor().long().clamp(0, TILES - 1)
        a, b = (tile.gather(-1, ((axis + n) % 3)[..., None])[..., 0] for n in (1, 2))
        albedo = colours[face, a, b] if painted else colours
        shade = 0.3 + 0.7 * ((T.rotation[i] @ normal) @ LIGHT).clamp_min(0)
        image = 255 * albedo * shade[..., None] + 2 * torch.randn(SIZE, SIZE, 3, generator=rng)
        inside = hit & torch.tensor(not LOST.start <= i < LOST.stop)
        images.append((image.clamp(0, 255) * inside[..., None]).to(torch.uint8))
        masks.append(torch.where(inside, OBJECT, BACKGROUND).to(torch.uint8))
    names = tuple(f"{i}.png" for i in range(FRAMES))
    return Capture(torch.stack(images), torch.stack(masks), CAMERA, names, "camera"), Trajectory(T, "camera")


def turned(truth: Trajectory) -> Trajectory:
    """Poses whose second part is a quarter turn off, as contours allow."""
    T = truth.T_cam_obj
    second = (torch.arange(FRAMES) >= LOST.stop)[:, None]
    wxyz = torch.where(second, (T.rotation @ QUARTER).wxyz, T.wxyz)
    return replace(truth, T_cam_obj=SE3(wxyz, T.xyz))


def usable() -> Tensor:
    seen = torch.ones(FRAMES, dtype=torch.bool)
    seen[LOST] = False
    return seen


def error(T: SE3, truth: Trajectory) -> float:
    """Median rotation error of the frames that show the object [degrees]."""
    a, b = (each.rotation[usable()].inverse() for each in (T, truth.T_cam_obj))
    return math.degrees(float(angle_between(b, mean_rotation(b @ a.inverse()) @ a).median()))


def gathered(capture: Capture) -> Inputs:
    return stage.gather(capture, [])


@pytest.fixture(scope="module")
def painted() -> tuple[Capture, Trajectory]:
    return film(painted=True)


@pytest.fixture(scope="module")
def plain() -> tuple[Capture, Trajectory]:
    return film(painted=False)


def test_turns_of_a_cube_are_found(painted: tuple[Capture, Trajectory]) -> None:
    """Where few views see along a face, the hull bulges, and not all 24 turns of the cube leave it as it is."""
    found = symmetry.estimate_turns(*painted, usable())
    assert found is not None
    turns = found.hull.turns[1:]
    assert len(turns) >= 7
    # Each takes axes to axes; the hull's cells are 3 degrees wide, seen from its centre.
    assert float(turns.abs().amax(-1).min()) > math.cos(math.radians(3))


def test_a_part_of_the_motion_that_is_a_quarter_turn_off_comes_back(painted: tuple[Capture, Trajectory]) -> None:
    capture, truth = painted
    wrong = turned(truth)
    assert error(wrong.T_cam_obj, truth) > 40
    found = symmetry.estimate_turns(capture, wrong, usable())
    assert found is not None
    assert found.is_better
    assert error(found.turned(wrong).T_cam_obj, truth) < 2
    # 19 of 40 frames are closer to the second part, a right angle off.
    assert math.degrees(found.doubt) == pytest.approx(90 * 19 / 40, abs=2)


def test_the_better_of_two_similar_turns_replaces_poses_that_colours_contradict_and_doubt_remains() -> None:
    capture, truth = film(painted=True, alike=0.75)
    found = symmetry.estimate_turns(capture, turned(truth), usable())
    assert found is not None
    assert found.is_better
    right = found.turned(turned(truth))
    assert error(right.T_cam_obj, truth) < 2
    again = symmetry.estimate_turns(capture, right, usable())
    assert again is not None
    assert not again.is_better
    # 19 of 40 frames are closer to the second part, which could be half a turn off.
    assert math.degrees(again.doubt) == pytest.approx(180 * 19 / 40, abs=2)


def test_right_poses_of_a_painted_cube_are_confirmed(painted: tuple[Capture, Trajectory]) -> None:
    capture, truth = painted
    found = symmetry.estimate_turns(capture, truth, usable())
    assert found is not None
    assert not found.is_better
    assert found.doubt == 0


@pytest.mark.parametrize("right", [True, False])
def test_a_plain_cube_is_left_alone_and_named_unsure(plain: tuple[Capture, Trajectory], right: bool) -> None:
    capture, truth = plain
    poses = truth if right else turned(truth)
    found = symmetry.estimate_turns(capture, poses, usable())
    assert found is not None
    assert not found.is_better
    assert found.doubt > MAX_USABLE_UNCERTAINTY


def test_an_uninterrupted_motion_is_certain(plain: tuple[Capture, Trajectory]) -> None:
    assert symmetry.estimate_turns(*plain, torch.ones(FRAMES, dtype=torch.bool)) is None


def state_at(cfg: stage.Config, inputs: Inputs, trajectory: Trajectory) -> State:
    """State of the stage with given poses."""
    state, T = stage.init(cfg, inputs, torch.Generator().manual_seed(0)), trajectory.T_cam_obj
    known = torch.zeros((), dtype=torch.float64)
    state.params = stage.Poses(T.rotation.matrix().double(), T.xyz.double() / DISTANCE, known)
    return state


def test_the_stage_turns_the_part_back(painted: tuple[Capture, Trajectory]) -> None:
    capture, truth = painted
    inputs, cfg = gathered(capture), stage.Config()
    state = state_at(cfg, inputs, turned(truth))
    state.step = [step.phase for step in stage.schedule(cfg)].index(stage.AlignColours())
    stage.step(cfg, inputs, state)
    assert error(SE3.from_rotation_matrix(state.params.R.float()), truth) < 2


def test_poses_that_colours_do_not_confirm_are_rated_bad(plain: tuple[Capture, Trajectory]) -> None:
    """Contours agree with the poses to a fraction of a pixel."""
    capture, truth = plain
    cfg, inputs = stage.Config(disagreement_scales=(0.5,), max_frontier_pairs=300), gathered(capture)
    quality = stage.finish(cfg, inputs, state_at(cfg, inputs, turned(truth))).quality
    assert quality.rating == "bad"
    assert quality.uncertainty > MAX_USABLE_UNCERTAINTY


def test_mirror_symmetry_is_computed_once(painted: tuple[Capture, Trajectory], monkeypatch: pytest.MonkeyPatch) -> None:
    """By `gather`: it depends on the capture alone."""
    capture, truth = (each.select(list(range(12))) for each in painted)
    inputs, cfg = gathered(capture), stage.Config(disagreement_scales=(0.5,))

    def again(*_: Tensor) -> Tensor:
        raise AssertionError("computed again")

    monkeypatch.setattr("tumble.poses.sfm.symmetry.mirror._centred", again)
    state = state_at(cfg, inputs, truth)
    for phase in (stage.AlignTexture(), stage.TrackTexture()):
        state.step = [step.phase for step in stage.schedule(cfg)].index(phase)
        stage.step(cfg, inputs, state)
    stage.finish(cfg, inputs, state)


def test_a_fast_motion_behind_lost_frames_is_kept_if_colours_confirm_it(painted: tuple[Capture, Trajectory]) -> None:
    """The cube rotates by more than frames of a smooth sequence may, as far as time alone tells."""
    capture, truth = painted
    frames = [*range(LOST.start + 1), *range(LOST.stop, FRAMES)]
    capture, truth = capture.select(frames), truth.select(frames)
    seen = usable()[frames]
    R = truth.T_cam_obj.rotation.matrix()
    assert int(longest_smooth_sequence(R, seen).sum()) < int(seen.sum())
    found = symmetry.estimate_turns(capture, truth, seen)
    assert found is not None
    assert torch.equal(longest_smooth_sequence(R, seen, found.confirmed), seen)
