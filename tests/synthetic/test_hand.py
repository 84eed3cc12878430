"""The hand that holds the object in a synthetic capture: joints, contacts, masks, and the twin without a hand."""

import dataclasses
import json
import math
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

mi = pytest.importorskip("mitsuba", reason="needs the extra `synth`")
trimesh = pytest.importorskip("trimesh", reason="needs the extra `synth`")
pytest.importorskip("scipy", reason="needs the extra `synth`")

from tumble.datasets import folder  # noqa: E402
from tumble.io import files, video  # noqa: E402
from tumble.maths.se3 import SE3  # noqa: E402
from tumble.synthetic import film, pathtracer, synthesize, trajectories  # noqa: E402
from tumble.synthetic.hand import arm, grasp, motion, rig  # noqa: E402
from tumble.synthetic.options import SynthOptions  # noqa: E402

# Dr.Jit emits deprecation warnings about its own code when it is imported.
pytestmark = pytest.mark.filterwarnings("ignore::DeprecationWarning")

HALF = np.array([0.3, 0.8, 0.52])
"""Half the sides of the box that is held."""
OPTIONS = SynthOptions(
    env="white", hand=True, background="wall", film=True, views=3, resolution=32, samples=4, truth_samples=4,
    eval_shared=1, eval_sphere=0, skin="dark",
)  # fmt: skip


@pytest.fixture(scope="module", autouse=True)
def few_placements() -> Iterator[None]:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(grasp, "PLACEMENTS", 60)
        patch.setattr(film, "SUBFRAMES", 2)
        yield


@pytest.fixture(scope="module")
def box(tmp_path_factory: pytest.TempPathFactory) -> Path:
    mesh = trimesh.creation.box(2 * HALF)
    mesh.visual = trimesh.visual.TextureVisuals(
        uv=np.zeros((8, 2)),
        material=trimesh.visual.material.PBRMaterial(baseColorTexture=Image.new("RGB", (2, 2), (150, 90, 60))),
    )
    path = tmp_path_factory.mktemp("box") / "box.glb"
    path.write_bytes(trimesh.Scene(mesh).export(file_type="glb"))
    return path


@pytest.fixture(scope="module")
def held(box: Path, tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    root = tmp_path_factory.mktemp("held")
    twin = dataclasses.replace(OPTIONS, hand=False, film=False)
    return {
        "hand": synthesize.render_capture(box, root / "hand", OPTIONS),
        "twin": synthesize.render_capture(box, root / "twin", twin),
    }


def distance_to_box(points: torch.Tensor) -> torch.Tensor:
    """The exact signed distance to the box, scaled into the unit sphere as `read_model` does."""
    offset = points.abs() - torch.from_numpy(HALF / np.linalg.norm(HALF))
    return offset.clamp_min(0).norm(dim=-1) + offset.amax(-1).clamp_max(0)


# Joints ---------------------------------------------------------------------------------------------------------------


def test_a_bent_joint_carries_its_finger_about_its_own_axis() -> None:
    hand = rig.read_rig()
    flexion, still = torch.zeros(2, 5, 3, dtype=torch.float64), torch.zeros(2, dtype=torch.float64)
    flexion[1, 1, 1] = math.radians(70)  # the middle joint of the index finger
    vertices = rig.skinned(hand, rig.joint_transforms(hand, flexion, still))
    torch.testing.assert_close(vertices[0], hand.vertices, atol=1e-6, rtol=0)
    # Rodrigues' rotation of the bind pose about the joint's x axis, by hand.
    joint = hand.bind[7]
    axis, offset, angle = -joint[:3, 0], hand.vertices - joint[:3, 3], torch.tensor(math.radians(70)).double()
    along = (offset @ axis)[:, None] * axis
    turned = along + angle.cos() * (offset - along) + angle.sin() * torch.linalg.cross(axis.expand_as(offset), offset)
    carried = hand.weights[:, [7, 8, 9]].sum(1)
    assert (carried > 0.999).sum() > 50
    tip = carried > 0.999
    torch.testing.assert_close(vertices[1][tip], (turned + joint[:3, 3])[tip], atol=1e-6, rtol=0)
    torch.testing.assert_close(vertices[1][carried == 0], hand.vertices[carried == 0], atol=1e-6, rtol=0)
    # The palm of the right hand faces its -y axis: there the fingertip goes.
    assert ((vertices[1] - hand.vertices)[tip] @ hand.bind[0, :3, 1]).mean() < -0.015


def test_opposition_takes_the_thumb_in_front_of_the_palm() -> None:
    hand = rig.read_rig()
    joints = rig.joint_transforms(hand, torch.zeros(2, 5, 3).double(), torch.tensor([0.0, 1.0]).double())
    moved = (joints[1, :, :3, 3] - joints[0, :, :3, 3]) @ hand.bind[0, :3, 1]
    assert moved[4] < -0.02
    assert moved[5:].abs().max() < 1e-9


# Contacts -------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("left", [False, True])
def test_fingers_end_on_the_surface(box: Path, left: bool) -> None:
    model = pathtracer.read_model(box)
    metre = 1 / grasp.object_radius(2 * HALF / np.linalg.norm(HALF))
    hand = rig.scaled(rig.read_rig(), metre)
    grasps = grasp.find_grasps(hand, grasp.signed_distance(*motion.surface_samples(model)), left=left, seed=0)
    assert len(grasps.score) >= 2
    vertices = grasps.vertices(hand, grasps.flexion)
    gap = distance_to_box(vertices)
    # 2 percent of the object's size, which is 2; the grid of signed distances has cells of 0.05.
    assert gap.min() > -0.04
    index, digit, _ = grasp.digit_vertices(hand)
    reached = torch.stack([gap[:, index[digit == d]].amin(1) < 0.03 for d in range(5)], 1)
    assert reached[:3].double().mean() > 0.7, "most digits of the best grasps touch"
    assert reached[:3, 0].all(), "the thumb does"
    # A left hand is a mirror image, and only that.
    assert torch.linalg.det(grasps.R_obj_hand).allclose(torch.tensor(-1.0 if left else 1.0).double())
    assert gap.new_tensor(metre).reciprocal() * 2 * HALF.min() / np.linalg.norm(HALF) <= grasp.GRASPABLE + 1e-9


# Grips ----------------------------------------------------------------------------------------------------------------


def test_the_hand_turns_with_the_object_and_changes_its_place(box: Path) -> None:
    poses = trajectories.turntable(24, trajectories.distance_for(math.radians(30)))
    plan = motion.plan(pathtracer.read_model(box), poses, facing=True, seed=0)
    assert len(plan.grips) >= 2
    assert [grip.end for grip in plan.grips[:-1]] == [grip.start for grip in plan.grips[1:]]
    resting = [t for t in range(24) if plan.openness(t) == 0 and plan.grip_at(t) is plan.grips[0]]
    first, last = (plan.parts(t, poses[t], 0.5, 0)["hand"].vertices for t in (resting[0], resting[-1]))
    np.testing.assert_array_equal(first, last)
    change = plan.grips[0].end
    leaving = plan.parts(change - 1e-6, poses[int(change)], 0.5, 0)["hand"].vertices
    assert distance_to_box(torch.from_numpy(leaving)).min() > 0.3, "the hand leaves before another one comes"
    for t in (resting[0], resting[-1]):
        sleeve = torch.from_numpy(plan.parts(t, poses[t], 0.5, 0)["sleeve"].vertices)
        end_cam = (poses[t] @ sleeve)[-29:]
        # The image is narrower than 1.2 object radii at the object's distance, and the film twice as wide.
        assert (end_cam[:, 0].abs() / end_cam[:, 2]).min() * poses[t].xyz[2] > 1.9


@pytest.mark.parametrize("length", [0.2, 0.26, 0.4])
def test_an_arm_of_any_length_has_the_same_topology(length: float) -> None:
    hand = rig.read_rig()
    wrist, along = hand.bind[0, :3, 3], torch.tensor([0.36, 0.48, 0.8], dtype=torch.float64)
    parts = arm.forearm_parts(hand, torch.eye(4, dtype=torch.float64), wrist + length * along, 1.0, 0.5, 0)
    assert {name: len(part.vertices) for name, part in parts.items()} == {"forearm": 15 * 29, "sleeve": 48 * 29}
    assert all(np.isfinite(part.vertices).all() for part in parts.values())
    end = parts["sleeve"].vertices[-29:].mean(0) - wrist.numpy()
    assert end @ along.numpy() > length, "the sleeve reaches beyond the elbow"


@pytest.mark.parametrize("length", [0.01, 0.03, 0.06, 0.09])
@pytest.mark.parametrize("along", [(0.36, 0.48, 0.8), (0.6, 0.8, 0.0), (0.36, 0.48, -0.8)])
def test_only_an_arm_that_is_too_short_for_its_sleeve_is_lengthened(length: float, along: tuple[float, ...]) -> None:
    """The curve may be long enough although its elbow is near; it then stays as it is."""
    hand = rig.read_rig()
    identity, wrist = torch.eye(4, dtype=torch.float64), hand.bind[0, :3, 3]
    elbow = wrist + length * torch.tensor(along, dtype=torch.float64)
    parts = arm.forearm_parts(hand, identity, elbow, 1.0, 0.5, 0)
    assert {name: len(part.vertices) for name, part in parts.items()} == {"forearm": 15 * 29, "sleeve": 48 * 29}
    rings = parts["sleeve"].vertices.reshape(48, 29, 3).mean(1)
    assert np.linalg.norm(np.diff(rings, axis=0), axis=1).min() > 0, "every ring is farther along the arm"
    # The last ring is around the end of the curve, 15 percent beyond the elbow (`forearm_curve`), unless it was moved.
    end = parts["sleeve"].vertices.reshape(48, 29, 3)[-1, :28].mean(0)
    curve = arm.forearm_curve(wrist - arm.INSIDE * hand.bind[0, :3, 2], hand.bind[0, :3, 2], elbow, 1.0)
    if curve.diff(dim=0).norm(dim=-1).sum() > 0.1:
        assert np.linalg.norm(end - curve[-1].numpy()) < 0.02


def test_a_dark_skin_is_darker_and_its_palm_lighter_than_its_back() -> None:
    light, dark = arm.skin_texture(0.0), arm.skin_texture(1.0)
    assert dark.mean() < 0.5 * light.mean()
    # In the texture the palm is the island on the right, its back the one on the left, or the other way round.
    back, palm = dark[300:360, 60:160].mean(), dark[170:230, 320:400].mean()
    assert max(back, palm) > 1.5 * min(back, palm)


# Captures -------------------------------------------------------------------------------------------------------------


def nearest_surfaces(parts: list[pathtracer.Part], T_cam_obj: SE3, camera: synthesize.Camera) -> np.ndarray:
    """Index of the part that each pixel's centre sees, -1 for none, by intersecting every ray with every triangle."""
    d_cam = camera.unproject(camera.pixel_centers(), torch.ones(camera.height, camera.width)).reshape(-1, 3).double()
    T_obj_cam = SE3(T_cam_obj.wxyz.double(), T_cam_obj.xyz.double()).inverse()
    d, origin = (T_obj_cam.rotation @ d_cam).numpy(), T_obj_cam.xyz.numpy()
    depth, nearest = np.full(len(d), np.inf), np.full(len(d), -1)
    for number, part in enumerate(parts):
        a, b, c = (part.vertices[part.faces[:, i]] - origin for i in range(3))
        volume = np.stack([d @ np.cross(p, q).T for p, q in ((b, c), (c, a), (a, b))])
        inside = (volume >= 0).all(0) | (volume <= 0).all(0)
        normal = np.cross(b - a, c - a)
        with np.errstate(divide="ignore", invalid="ignore"):
            t = (a * normal).sum(1) / (d @ normal.T)
        t = np.where(inside & (t > 0), t, np.inf).min(1)
        nearest, depth = np.where(t < depth, number, nearest), np.minimum(t, depth)
    return nearest.reshape(camera.height, camera.width)


def test_masks_agree_with_an_independent_ray_cast(held: dict[str, Path], box: Path) -> None:
    context = synthesize._context(pathtracer.read_model(box, OPTIONS.up), held["hand"], OPTIONS)
    agreement, hands, objects = [], 0, 0
    for i in (0, 2):
        name = f"{i:04}"
        hand_parts, background = context.surroundings.at(i, context.poses[i])
        parts = [*context.model.parts, *hand_parts.values(), *background.values()]
        nearest = nearest_surfaces(parts, context.poses[i], context.camera)
        object_mask, hand_mask = (
            files.read_image(held["hand"] / "truth" / kind / f"{name}.png")[..., 0]
            for kind in ("object_mask", "hand_mask")
        )
        assert not (object_mask & hand_mask).any()
        hands, objects = hands + bool(hand_mask.any()), objects + bool(object_mask.any())
        expected_hand = (nearest >= 1) & (nearest <= len(hand_parts))
        agreement.append(((object_mask > 0) == (nearest == 0)).mean())
        agreement.append(((hand_mask > 0) == expected_hand).mean())
    assert hands == objects == 2
    # A pixel's centre and the larger part of its area disagree at some pixels of a contour.
    assert min(agreement) > 0.97


def test_the_mask_of_a_capture_calls_the_hand_unknown(held: dict[str, Path]) -> None:
    capture = folder.load(held["hand"])
    for i, name in enumerate(capture.names):
        truth = held["hand"] / "truth"
        assert (
            (capture.masks[i].numpy() == 255) == (files.read_image(truth / "object_mask" / name)[..., 0] > 0)
        ).mean() > 0.99
        hand = files.read_image(truth / "hand_mask" / name)[..., 0] > 0
        assert (capture.masks[i].numpy()[hand] == 128).all()


def test_the_twin_without_the_hand_has_the_same_motion_light_and_evaluation(held: dict[str, Path]) -> None:
    hand, twin = held["hand"], held["twin"]
    for name in ("truth/poses.json", "truth/light.hdr", "transforms.json", "images/0003.png", "truth/albedo/0003.exr"):
        assert (hand / name).read_bytes() == (twin / name).read_bytes(), name
    assert not (files.read_image(hand / "images/0000.png") == files.read_image(twin / "images/0000.png")).all()
    # Where the twin's object is visible, it is hidden by the hand or visible in both.
    for i in range(3):
        with_hand, without = (
            files.read_image(path / "truth" / "object_mask" / f"{i:04}.png")[..., 0] > 0 for path in (hand, twin)
        )
        assert not (with_hand & ~without).any()


def test_the_film_is_a_wider_view_of_the_capture_with_a_box_on_its_first_frame(held: dict[str, Path]) -> None:
    path = held["hand"]
    frames = np.stack(list(video.read_clip(path / "film.mp4")))
    assert frames.shape == (3, 48, 64, 3)
    images = np.stack([files.read_image(path / "images" / f"{i:04}.png") for i in range(3)])
    # The capture's image is the centre of the film: next to it the difference is larger.
    difference = {
        (down, right): np.abs(frames[:, 8 + down : 40 + down, 16 + right : 48 + right].astype(float) - images).mean()
        for down, right in ((0, 0), (3, 0), (-3, 0), (0, 3), (0, -3))
    }
    assert min(difference, key=difference.get) == (0, 0)
    document = json.loads((path / "film.json").read_text())
    left, top, width, height = document["box"]
    mask = files.read_image(path / "truth" / "film_object_mask" / "0000.png")[..., 0] > 0
    assert mask[top : top + height, left : left + width].sum() == mask.sum() > 0
    assert document["focal"] == pytest.approx(json.loads((path / "transforms.json").read_text())["fl_x"])


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"hand": True, "setting": "turntable"}, "--setting handheld"),
        ({"background": "desk", "setting": "dome"}, "camera of a dome moves"),
        ({"film": True, "setting": "dome"}, "camera of a dome moves"),
        ({"skin": 1.5}, "skin is out of range"),
    ],
)
def test_options_that_do_not_fit_together_are_refused(change: dict, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        SynthOptions(env="white", **change)
