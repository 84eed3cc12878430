"""The examples run with the SMOKE recipe, in seconds, and write what they document."""

import math
from pathlib import Path

import pytest
import torch

from examples import bring_your_own_poses, reconstruct_and_relight, swap_a_stage
from tests.poses.sfm.test_stage import QUICK
from tumble import demo, recipes
from tumble.io import files

RECIPE = recipes.replace(recipes.SMOKE, track=QUICK)


@pytest.fixture(autouse=True)
def short_clip(monkeypatch: pytest.MonkeyPatch) -> None:
    """Unpack only the first 12 frames and 2 evaluation views of the bundled clip."""
    unpack = demo.unpack

    def shortened(out: Path) -> Path:
        document = files.read_json(unpack(out) / "transforms.json")
        train, views = ([frame for frame in document["frames"] if frame["split"] == x] for x in ("train", "eval"))
        document["frames"] = train[:12] + views[:2]
        files.write_json(out / "transforms.json", document)
        return out

    monkeypatch.setattr(demo, "unpack", shortened)


def test_a_clip_is_reconstructed_and_relit(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    asset = reconstruct_and_relight.main(tmp_path, RECIPE)
    assert torch.isfinite(asset.environment.radiance).all()
    assert all(files.read_image(tmp_path / name).max() > 30 for name in ("albedo.png", "sunset.png"))
    assert "refine: step 30 of 30" in capsys.readouterr().out


def test_given_poses_are_not_changed(tmp_path: Path) -> None:
    scores = bring_your_own_poses.main(tmp_path, RECIPE)
    assert scores["poses"]["poses.rotation_mean_degrees"] < 0.01
    assert (tmp_path / "export" / "asset.ply").is_file()
    assert (tmp_path / "scores" / "sheet.png").is_file()


def test_a_custom_stage_replaces_stage_3(tmp_path: Path) -> None:
    psnr = swap_a_stage.main(tmp_path, RECIPE)
    assert psnr["ours"] != psnr["stage 2 alone"]
    assert all(math.isfinite(value) for value in psnr.values())
