"""Trees of tensors: names, maps, saving and loading; and plugins."""

from dataclasses import dataclass
from pathlib import Path

import pytest
import torch
from torch import Tensor

from tumble.io import plugins, read_tensors, tree, write_tensors
from tumble.io.errors import BadFile
from tumble.maths.se3 import SE3
from tumble.scene.asset import Asset
from tumble.scene.camera import Camera
from tumble.scene.environment import Environment
from tumble.scene.gaussians import Gaussians
from tumble.scene.material import Material
from tumble.scene.trajectory import Trajectory


@dataclass(frozen=True)
class SmallTree:
    x: Tensor
    more: dict[str, Tensor]
    word: str
    sizes: tuple[int, ...]
    nothing: Tensor | None


def make_asset() -> Asset:
    torch.manual_seed(0)
    gaussians = Gaussians(torch.randn(5, 3), torch.randn(5, 4), torch.randn(5, 3), torch.randn(5), torch.randn(5, 4, 3))
    return Asset(
        gaussians=gaussians,
        gamma=torch.tensor(7.0),
        material=Material.constant(5, torch.tensor([0.2, 0.5, 0.7]), 0.3),
        environment=Environment.from_radiance(torch.rand(4, 8, 3)),
        trajectory=Trajectory(SE3.exp(torch.randn(3, 6)), "camera"),
        camera=Camera.from_fov(0.5, 6, 8),
    )


def test_a_loaded_asset_equals_the_saved_one_bit_for_bit(tmp_path: Path) -> None:
    asset = make_asset()
    tree.save(asset, tmp_path / "asset.safetensors")
    again = tree.load(Asset, tmp_path / "asset.safetensors")
    before, after = tree.named_tensors(asset), tree.named_tensors(again)
    assert list(before) == list(after)
    assert all(torch.equal(before[name], after[name]) for name in before)
    assert again.trajectory.light == "camera"
    assert (again.camera.height, again.camera.width) == (6, 8)
    assert [p.name for p in tmp_path.iterdir()] == ["asset.safetensors"]


def test_plain_values_dicts_and_none_are_saved_and_loaded(tmp_path: Path) -> None:
    small = SmallTree(torch.arange(3), {"a": torch.ones(2), "b": torch.zeros(1)}, "word", (1, 2), None)
    tree.save(small, tmp_path / "small")
    again = tree.load(SmallTree, tmp_path / "small")
    assert (again.word, again.sizes, again.nothing) == ("word", (1, 2), None)
    assert list(again.more) == ["a", "b"]
    assert torch.equal(again.x, small.x)


def test_views_of_one_storage_can_be_saved(tmp_path: Path) -> None:
    whole = torch.arange(6.0)
    tree.save(SmallTree(whole[:3], {"tail": whole[3:]}, "", (), None), tmp_path / "views")
    assert tree.load(SmallTree, tmp_path / "views").more["tail"].tolist() == [3, 4, 5]


def test_loading_another_class_is_rejected(tmp_path: Path) -> None:
    tree.save(Camera.from_fov(0.5, 2, 2), tmp_path / "camera")
    with pytest.raises(ValueError, match="holds a Camera, not a Asset"):
        tree.load(Asset, tmp_path / "camera")


@pytest.mark.parametrize(
    ("name", "tensor", "rule"),
    [
        ("gaussians.means", torch.zeros(5, 4), r"means\": expected Float\[Tensor, 'n 3'\], got torch.float32 \[5, 4\]"),
        ("gaussians.sdf", torch.zeros(4), "sdf"),
        ("gamma", torch.zeros(()).int(), '"gamma": expected .*, got torch.int32'),
        ("gamma", None, "lacks|KeyError: 'gamma'"),
    ],
)
def test_tensors_of_another_shape_or_type_are_rejected(
    tmp_path: Path, name: str, tensor: Tensor | None, rule: str
) -> None:
    tree.save(make_asset(), tmp_path / "asset")
    tensors, header = read_tensors(tmp_path / "asset", "fix")
    tensors = {key: value for key, value in tensors.items() if key != name} | ({} if tensor is None else {name: tensor})
    write_tensors(tmp_path / "asset", tensors, header)
    with pytest.raises(BadFile, match=rule):
        tree.load(Asset, tmp_path / "asset")


def test_plain_values_of_another_type_are_rejected(tmp_path: Path) -> None:
    tree.save(make_asset(), tmp_path / "asset")
    tensors, header = read_tensors(tmp_path / "asset", "fix")
    wrong = {**header, "facts": header["facts"].replace('"fact": 6', '"fact": "six"')}
    assert wrong != header
    write_tensors(tmp_path / "asset", tensors, wrong)
    with pytest.raises(BadFile, match=r'asset: holds no valid Asset: "camera\.height": expected int, got str'):
        tree.load(Asset, tmp_path / "asset")


def test_a_single_value_with_a_stride_of_zero_is_written(tmp_path: Path) -> None:
    single = torch.tensor(2.5).expand(1)
    assert single.stride() == (0,)
    write_tensors(tmp_path / "one", {"x": single}, {})
    assert torch.equal(read_tensors(tmp_path / "one", "fix")[0]["x"], single)


def test_map_changes_every_tensor_and_no_plain_value() -> None:
    doubled = tree.map(lambda x: 2 * x, make_asset())
    assert torch.equal(doubled.gaussians.means, 2 * make_asset().gaussians.means)
    assert doubled.trajectory.light == "camera"
    assert tree.named_tensors(doubled)["trajectory.T_cam_obj.xyz"].shape == (3, 3)
    assert not tree.detach(tree.map(lambda x: x.requires_grad_(), make_asset())).gamma.requires_grad


def test_plugins_load_by_file_name_and_an_unknown_name_lists_the_available() -> None:
    assert hasattr(plugins.load_plugin("datasets", "folder"), "load")
    with pytest.raises(ValueError, match=r"no 'nope' in tumble/datasets; available: .*folder"):
        plugins.load_plugin("datasets", "nope")
