"""The adapters of SAM 2 and SAM 3, tested with mock predictors that follow their public interfaces."""

import sys
from pathlib import Path
from types import ModuleType, SimpleNamespace

import numpy as np
import pytest
import torch

from tumble.io.files import BadFile
from tumble.preprocess import sam
from tumble.preprocess.segmentation import Seed

IMAGES = np.zeros((4, 20, 30, 3), np.uint8)
CALLS: list = []


class Sam2:
    """Returns the given box, shifted by one column per frame."""

    def init_state(self, video_path: str, offload_video_to_cpu: bool) -> SimpleNamespace:
        assert len(list(Path(video_path).glob("*.jpg"))) == 4
        return SimpleNamespace()

    def add_new_points_or_box(self, inference_state, frame_idx, obj_id, points=None, labels=None, box=None):
        self.start, self.box = frame_idx, box
        CALLS.append((points, labels))

    def propagate_in_video(self, state, start_frame_idx: int, reverse: bool):
        order = range(start_frame_idx, -1, -1) if reverse else range(start_frame_idx, 4)
        for i in order:
            logits = torch.full((1, 1, 20, 30), -5.0)
            left, top, right, bottom = map(int, self.box if self.box is not None else (0, 0, 2, 2))
            logits[..., top:bottom, left + i - self.start : right + i - self.start] = 5.0
            yield i, [1], logits


class Sam3:
    def handle_request(self, request: dict) -> dict:
        CALLS.append(request)
        return {"session_id": "s"}

    def handle_stream_request(self, request: dict):
        CALLS.append(request)
        for i in (1, 2, 3, 0):
            masks = np.zeros((2, 20, 30), bool)
            masks[0, :2], masks[1, 5:9, 5 + i] = True, True
            yield {"frame_index": i, "outputs": {"out_binary_masks": masks, "out_probs": np.array([0.2, 0.9])}}


@pytest.fixture
def weights(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    path = tmp_path / "sam2.1_hiera_small.pt"
    path.write_bytes(b"weights")
    CALLS.clear()
    two, three = ModuleType("sam2.build_sam"), ModuleType("sam3.model_builder")
    two.build_sam2_video_predictor = lambda config, path, device: CALLS.append(config) or Sam2()
    three.build_sam3_video_predictor = lambda checkpoint_path: Sam3()
    for name, module in (("sam2", ModuleType("sam2")), ("sam3", ModuleType("sam3"))):
        monkeypatch.setitem(sys.modules, name, module)
    monkeypatch.setitem(sys.modules, "sam2.build_sam", two)
    monkeypatch.setitem(sys.modules, "sam3.model_builder", three)
    return path


def test_sam2_receives_corners_and_returns_masks_of_all_frames(weights: Path) -> None:
    masks = sam.sam2(IMAGES, Seed(1, box=(4, 6, 10, 8)), weights)
    assert CALLS[0] == "configs/sam2.1/sam2.1_hiera_s.yaml"
    for i in range(4):
        rows, columns = np.nonzero(masks[i])
        assert (rows.min(), rows.max()) == (6, 13)
        assert (columns.min(), columns.max()) == (4 + i - 1, 13 + i - 1)


def test_sam2_receives_a_click_as_a_positive_point(weights: Path) -> None:
    sam.sam2(IMAGES, Seed(0, click=(3, 5)), weights)
    points, labels = CALLS[-1]
    assert points.tolist() == [[3, 5]]
    assert labels.tolist() == [1]


def test_sam3_receives_relative_coordinates_and_its_most_probable_mask_is_used(weights: Path) -> None:
    masks = sam.sam3(IMAGES, Seed(2, box=(3, 5, 15, 10)), weights)
    (prompt,) = [call for call in CALLS if call["type"] == "add_prompt"]
    assert prompt["bounding_boxes"] == [[0.1, 0.25, 0.5, 0.5]]
    assert prompt["frame_index"] == 2
    assert [call["type"] for call in CALLS] == ["start_session", "add_prompt", "propagate_in_video", "close_session"]
    for i in range(4):
        assert masks[i].sum() == 4
        assert masks[i, 5:9, 5 + i].all()


@pytest.mark.parametrize("name", ["sam2", "sam3"])
def test_missing_weights_and_packages_are_reported_with_the_fix(
    name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with pytest.raises(BadFile, match=r"is missing; it should hold the weights of SAM .*\.pt"):
        sam.SEGMENTERS[name](IMAGES, Seed(0, box=(1, 1, 5, 5)), tmp_path / "large.pt")
    (tmp_path / "large.pt").write_bytes(b"x")
    monkeypatch.setitem(sys.modules, name, None)
    with pytest.raises(ModuleNotFoundError, match=r"is not installed .*install"):
        sam.SEGMENTERS[name](IMAGES, Seed(0, box=(1, 1, 5, 5)), tmp_path / "large.pt")
    (tmp_path / "mine.pt").write_bytes(b"x")
    with pytest.raises(BadFile, match="has a name without the size of the model"):
        sam.sam2(IMAGES, Seed(0, box=(1, 1, 5, 5)), tmp_path / "mine.pt")
