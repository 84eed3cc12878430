"""A light that turns by itself is in the same frame wherever a trajectory is used, and comes back from its folder."""

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch

from tumble.datasets import folder
from tumble.datasets._capture_folder import save_capture
from tumble.io.files import BadFile
from tumble.maths.se3 import SE3, SO3
from tumble.scene.camera import Camera
from tumble.scene.capture import Capture, content_key
from tumble.scene.trajectory import Light, Trajectory


def turning(light: Light) -> Trajectory:
    rng = torch.Generator().manual_seed(4)
    poses, turns = SO3.exp(torch.randn(4, 3, generator=rng)), SO3.exp(torch.randn(4, 3, generator=rng))
    return Trajectory(SE3.from_rotation(poses, torch.tensor([0.0, 0.0, 4.0])), light, turns.matrix())


@pytest.mark.parametrize("light", ["camera", "object"])
def test_a_turn_is_applied_after_the_frame_of_the_light(light: Light) -> None:
    path = turning(light)
    assert path.light_turns is not None
    still = replace(path, light_turns=None)
    torch.testing.assert_close(path.R_env_obj, path.light_turns @ still.R_env_obj)
    corrected = SE3.exp(0.1 * torch.arange(6.0)) @ path.T_cam_obj[2]
    moved = replace(path, T_cam_obj=SE3(corrected.wxyz.expand(4, 4), corrected.xyz.expand(4, 3)))
    torch.testing.assert_close(path.R_env_obj_at(2, corrected), moved.R_env_obj[2])
    torch.testing.assert_close(path.select([3, 1]).R_env_obj, path.R_env_obj[[3, 1]])


def saved(path: Path) -> Path:
    images = torch.full((4, 16, 16, 3), 90, dtype=torch.uint8)
    masks = torch.zeros(4, 16, 16, dtype=torch.uint8)
    masks[:, 4:12, 4:12] = 255
    names = tuple(f"{i}.png" for i in range(4))
    save_capture(path, Capture(images, masks, Camera.from_fov(0.5, 16, 16), names, "object", turning("object")))
    return path


def test_the_turns_of_a_folder_are_read_and_part_of_the_key(tmp_path: Path) -> None:
    capture = folder.load(saved(tmp_path / "a"))
    wanted = turning("object")
    assert capture.trajectory is not None
    torch.testing.assert_close(capture.trajectory.R_env_obj, wanted.R_env_obj)
    still = replace(capture, trajectory=replace(capture.trajectory, light_turns=None))
    assert content_key(still) != content_key(capture)


BROKEN: dict[str, Any] = {
    '1.png: "light_turn" is not a rotation': lambda frames: frames[1].update(
        light_turn=[[2, 0, 0], [0, 2, 0], [0, 0, 2]]
    ),
    'the frame 2.png has no "light_turn", but others have': lambda frames: frames[2].pop("light_turn"),
    'has "light_turn" without poses': lambda frames: [frame.pop("transform_matrix") for frame in frames],
    "light_turn.*expected array of length 3": lambda frames: frames[0].update(light_turn=[[1, 0, 0]]),
}


@pytest.mark.parametrize("rule", BROKEN)
def test_wrong_turns_are_refused(rule: str, tmp_path: Path) -> None:
    path = saved(tmp_path / "a") / "transforms.json"
    document = json.loads(path.read_text())
    BROKEN[rule](document["frames"])
    path.write_text(json.dumps(document))
    with pytest.raises(BadFile, match=rule):
        folder.load(path.parent)
