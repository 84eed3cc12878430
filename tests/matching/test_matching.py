"""The matchers, all behind one signature: a picture under a known homography is the oracle."""

import itertools
import sys
import types
from collections.abc import Callable

import cv2
import numpy as np
import pytest
import safetensors.torch
import torch

from tumble import matching
from tumble.io import weights
from tumble.io.files import BadFile
from tumble.io.plugins import named, names
from tumble.matching import _aliked, _gmflow, _lightglue, _window, match_pairs, xfeat
from tumble.scene.capture import BACKGROUND, OBJECT, UNKNOWN
from tumble.scene.match import Match, View

SIZE = 128
NOT_HERE = {"roma": "needs an installation of romav2", "mast3r": "needs an installation of mast3r"}
WARP = np.array([[0.97, -0.10, 9.0], [0.09, 1.02, -6.0], [2e-4, -1e-4, 1.0]])
"""A turn, a stretch and some perspective, in positions with pixel centres at +0.5; nothing about it is symmetric."""


def texture(seed: int = 0) -> np.ndarray:
    """Blobs of all sizes in colour, so that every matcher finds something to hold on to."""
    rng = np.random.default_rng(seed)
    layers = [cv2.resize(rng.normal(size=(n, n, 3)), (SIZE, SIZE), interpolation=cv2.INTER_CUBIC) for n in (8, 20, 50)]
    picture = sum(layers)
    return (127 + 45 * picture).clip(0, 255).astype(np.uint8)


def warped(values: np.ndarray, flags: int) -> np.ndarray:
    """A picture seen through WARP; OpenCV counts pixel centres from 0."""
    half = np.array([[1, 0, 0.5], [0, 1, 0.5], [0, 0, 1.0]])
    return cv2.warpPerspective(values, np.linalg.inv(half) @ WARP @ half, (SIZE, SIZE), flags=flags)


def through(uv: torch.Tensor) -> torch.Tensor:
    x = torch.cat([uv.double(), torch.ones(len(uv), 1).double()], -1) @ torch.from_numpy(WARP).T
    return (x[:, :2] / x[:, 2:]).float()


def pair() -> tuple[View, View]:
    """A round object with a hand over its lower right, and the same through WARP."""
    rows, columns = np.mgrid[:SIZE, :SIZE]
    mask = np.where((columns - 66) ** 2 + (rows - 60) ** 2 < 48**2, OBJECT, BACKGROUND).astype(np.uint8)
    mask[(rows > 80) & (columns > 70)] = UNKNOWN
    image = texture()
    image[mask != OBJECT] = 0
    views = (image, mask), (warped(image, cv2.INTER_CUBIC), warped(mask, cv2.INTER_NEAREST))
    i, j = (View(n, torch.from_numpy(im), torch.from_numpy(m)) for n, (im, m) in zip((7, 3), views, strict=True))
    return i, j


@pytest.fixture(params=names("matching"))
def matcher(request: pytest.FixtureRequest) -> matching.Matcher:
    if request.param in NOT_HERE:
        pytest.skip(f"{request.param} {NOT_HERE[request.param]}")
    if request.param in weights.SOURCES and not weights.present(request.param):
        pytest.skip(f"{request.param} needs its weights: tumble weights get {request.param}")
    return named("matching", request.param).load("cpu")


def on_sure_pixels(match: Match, view_i: View, view_j: View) -> bool:
    return all(
        bool(_window.sure_pixels(view.mask)[row, column])
        for view, uv in ((view_i, match.uv_i), (view_j, match.uv_j))
        for column, row in uv.long().tolist()
    )


def test_a_known_warp_is_found(matcher: matching.Matcher) -> None:
    view_i, view_j = pair()
    match = matcher(view_i, view_j)
    assert (match.i, match.j) == (7, 3)
    assert len(match) >= 20
    error = (through(match.uv_i) - match.uv_j).norm(dim=-1)
    assert float(error.median()) < 1
    assert float((error < 2).float().mean()) > 0.8
    assert 0 <= float(match.confidence.min()) <= float(match.confidence.max()) <= 1
    # Points of one sort must not all lie in one corner: half the object's width at least.
    assert bool((match.uv_i.amax(0) - match.uv_i.amin(0) > 45).all())


def test_there_is_no_bias(matcher: matching.Matcher) -> None:
    """A quarter or half of a pixel, the mark of a wrong convention, would show in the mean over many points."""
    view_i, view_j = pair()
    match = matcher(view_i, view_j)
    error = through(match.uv_i) - match.uv_j
    good = error.norm(dim=-1) < 2
    assert float(error[good].mean(0).abs().max()) < 0.15


def test_masks_are_respected(matcher: matching.Matcher) -> None:
    """Neither background, nor a hand, nor the border of the mask, in either frame."""
    view_i, view_j = pair()
    assert on_sure_pixels(matcher(view_i, view_j), view_i, view_j)


def test_what_stands_still_around_the_object_is_not_seen(matcher: matching.Matcher) -> None:
    view_i, view_j = pair()
    still = torch.from_numpy(texture(seed=5))
    views = [View(v.number, torch.where(v.mask[..., None] == OBJECT, v.image, still), v.mask) for v in (view_i, view_j)]
    match = matcher(*views)
    error = (through(match.uv_i) - match.uv_j).norm(dim=-1)
    assert float(error.median()) < 1
    plain = matcher(view_i, view_j)
    assert abs(len(match) - len(plain)) <= 0.1 * len(plain), "what is found does not depend on the background"


def test_without_an_object_there_is_no_match(matcher: matching.Matcher) -> None:
    view_i, view_j = pair()
    empty = View(3, view_j.image, torch.full_like(view_j.mask, UNKNOWN))
    assert len(matcher(view_i, empty)) == 0
    assert len(matcher(empty, View(4, view_i.image, view_i.mask))) == 0


def test_swapped_frames_correspond_all_the_same(matcher: matching.Matcher) -> None:
    view_i, view_j = pair()
    there, back = matcher(view_i, view_j), matcher(view_j, view_i).reversed()
    assert (back.i, back.j) == (there.i, there.j)
    error = (through(back.uv_i) - back.uv_j).norm(dim=-1)
    assert float(error.median()) < 1
    # A dense matcher starts from a grid in the other frame: as many points, give and take, not the same ones.
    assert abs(len(there) - len(back)) <= 0.15 * len(there)


def test_sift_is_exactly_symmetric() -> None:
    view_i, view_j = pair()
    match = named("matching", "sift").load("cpu")
    there, back = match(view_i, view_j), match(view_j, view_i).reversed()
    rows = [torch.cat([m.uv_i, m.uv_j, m.confidence[:, None]], 1) for m in (there, back)]
    torch.testing.assert_close(*(r[np.lexsort(r.numpy().T)] for r in rows))


# Windows --------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("size", [40, 300])
def test_windows_know_where_they_lie(size: int) -> None:
    """A bright dot is found again at its place, enlarged or reduced."""
    image = np.zeros((SIZE, SIZE, 3), np.float32)
    rows, columns = np.mgrid[:SIZE, :SIZE] + 0.5
    image += 255 * np.exp(-((columns - 61.3) ** 2 + (rows - 44.8) ** 2) / (2 * 3.0**2))[..., None]
    mask = torch.zeros(SIZE, SIZE, dtype=torch.uint8)
    mask[20:90, 30:100] = OBJECT
    look = _window.window(View(0, torch.from_numpy(image.astype(np.uint8)), mask), 80.0, size)
    # Only the dot: around the object lies the fill.
    light = look.rgb[..., 0].astype(np.float64) * (look.rgb[..., 0] > 20)
    rows, columns = np.mgrid[:size, :size] + 0.5
    centroid = np.array([[(light * columns).sum(), (light * rows).sum()]]) / light.sum()
    # The threshold cuts a disc out of 40 x 40 pixels of 2 unevenly, by a fiftieth of a pixel.
    torch.testing.assert_close(look.in_frame(centroid), torch.tensor([[61.3, 44.8]]), atol=0.06, rtol=0)


def test_shading_and_exposure_leave_little_in_what_is_matched() -> None:
    """The same texture in a light that rises threefold across the object: pixels differ by 60 code values and more,
    what is matched by a few of its 45 per standard deviation."""
    view, _ = pair()
    columns = torch.arange(SIZE) / SIZE
    shaded = (view.image * (0.4 + 0.8 * columns)[None, :, None]).to(torch.uint8)
    plain, other = (_window.window(View(0, image, view.mask), 110.0, 384) for image in (view.image, shaded))
    sure = plain.sure
    assert np.abs(plain.rgb[sure].astype(float) - other.rgb[sure]).mean() > 25
    assert np.abs(plain.grey[sure].astype(float) - other.grey[sure]).mean() < 8


def test_masks_lose_their_border_but_not_at_the_frame() -> None:
    mask = torch.zeros(128, 128, dtype=torch.uint8)
    mask[50:, 20:80] = OBJECT
    mask[50:, 60:80] = UNKNOWN
    sure = _window.sure_pixels(mask)
    rows, columns = np.nonzero(sure)
    assert (rows.min(), rows.max(), columns.min(), columns.max()) == (52, 127, 22, 57)


def test_the_fill_has_no_edge() -> None:
    """Around a grey object on white, all is grey: no edge is left that would not move with the surface."""
    view_i, _ = pair()
    image = torch.where(view_i.mask[..., None] == OBJECT, 90, 255).to(torch.uint8).expand(-1, -1, 3).contiguous()
    look = _window.window(View(0, image, view_i.mask), 110.0, 220)
    assert int(look.rgb.min()) >= 89
    assert int(look.rgb.max()) <= 91


# The cache ------------------------------------------------------------------------------------------------------------


def same(a: Match, b: Match) -> bool:
    return (a.i, a.j) == (b.i, b.j) and all(
        torch.equal(getattr(a, name), getattr(b, name)) for name in ("uv_i", "uv_j", "confidence")
    )


def forbid(monkeypatch: pytest.MonkeyPatch, name: str) -> None:
    def load(device: object) -> Callable:
        raise AssertionError("must not be loaded")

    monkeypatch.setattr(named("matching", name), "load", load)


def test_what_is_cached_is_not_computed_again(tmp_path, monkeypatch: pytest.MonkeyPatch) -> None:
    views = list(pair())
    first = match_pairs(views, [(0, 1), (1, 0)], "dis", cache=tmp_path)
    assert len(list(tmp_path.iterdir())) == 2
    forbid(monkeypatch, "dis")
    again = match_pairs(views, [(0, 1), (1, 0)], "dis", cache=tmp_path)
    assert all(same(a, b) for a, b in zip(first, again, strict=True))


def test_frames_may_have_other_numbers_in_the_cache(tmp_path, monkeypatch: pytest.MonkeyPatch) -> None:
    view_i, view_j = pair()
    match_pairs([view_i, view_j], [(0, 1)], "dis", cache=tmp_path)
    forbid(monkeypatch, "dis")
    moved = [View(90, view_i.image, view_i.mask), View(91, view_j.image, view_j.mask)]
    assert [(m.i, m.j) for m in match_pairs(moved, [(0, 1)], "dis", cache=tmp_path)] == [(90, 91)]


def test_other_masks_and_settings_are_other_files(tmp_path, monkeypatch: pytest.MonkeyPatch) -> None:
    view_i, view_j = pair()
    match_pairs([view_i, view_j], [(0, 1)], "mixed", cache=tmp_path)
    mask = view_j.mask.clone()
    mask[60, 60] = UNKNOWN
    match_pairs([view_i, View(3, view_j.image, mask)], [(0, 1)], "mixed", cache=tmp_path)
    assert len(list(tmp_path.iterdir())) == 2
    monkeypatch.setattr(named("matching", "dis"), "BACK", 1.0)
    match_pairs([view_i, view_j], [(0, 1)], "mixed", cache=tmp_path)
    assert len(list(tmp_path.iterdir())) == 3, "mixed is made of dis, whose settings changed"


def test_a_damaged_cache_says_what_to_do(tmp_path) -> None:
    views = list(pair())
    match_pairs(views, [(0, 1)], "dis", cache=tmp_path)
    (path,) = tmp_path.iterdir()
    path.write_bytes(b"no tensors")
    with pytest.raises(BadFile, match="delete it"):
        match_pairs(views, [(0, 1)], "dis", cache=tmp_path)
    safetensors.torch.save_file({"uv_i": torch.zeros(1, 2)}, path)
    with pytest.raises(BadFile, match="is no match"):
        match_pairs(views, [(0, 1)], "dis", cache=tmp_path)


def test_unknown_matchers_are_answered_with_the_known() -> None:
    with pytest.raises(ValueError, match=r"dis, .*mixed, .*sift"):
        match_pairs(list(pair()), [(0, 1)], "eyes")


# Networks without their weights ---------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", sorted(weights.SOURCES))
def test_missing_weights_are_named(name: str, tmp_path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    with pytest.raises(BadFile, match=f"tumble weights get {name}"):
        named("matching", name).load("cpu")


@pytest.mark.parametrize("name", sorted(NOT_HERE))
def test_missing_packages_are_named(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    for package in ("romav2", "mast3r", "mast3r.model", "dust3r", "dust3r.inference"):
        monkeypatch.setitem(sys.modules, package, None)
    with pytest.raises(ModuleNotFoundError, match=f"the matcher {name} needs"):
        named("matching", name).load("cpu")


def test_a_deformable_convolution_without_offsets_is_a_convolution() -> None:
    rng = torch.Generator().manual_seed(0)
    x, kernel = torch.randn(1, 3, 7, 9, generator=rng), torch.randn(4, 3, 3, 3, generator=rng)
    out = _aliked.deformable(x, torch.zeros(1, 18, 7, 9), kernel)
    torch.testing.assert_close(out, torch.nn.functional.conv2d(x, kernel, padding=1), atol=1e-5, rtol=1e-5)


def test_a_deformable_convolution_moves_each_tap_by_itself() -> None:
    """The kernel's third tap, in its top right corner, is sent 2 down and 1.5 left for one pixel."""
    x = torch.arange(63.0).reshape(1, 1, 7, 9)
    kernel = torch.zeros(1, 1, 3, 3)
    kernel[0, 0, 0, 2] = 1.0
    offsets = torch.zeros(1, 18, 7, 9)
    offsets[0, 4, 3, 4], offsets[0, 5, 3, 4] = 2.0, -1.5
    out = _aliked.deformable(x, offsets, kernel)
    # Row 3 - 1 + 2 = 4, column 4 + 1 - 1.5 = 3.5; without offsets row 1, column 6 for pixel (2, 5).
    assert float(out[0, 0, 3, 4]) == pytest.approx(4 * 9 + 3.5, abs=1e-4)
    assert float(out[0, 0, 2, 5]) == pytest.approx(1 * 9 + 6, abs=1e-4)


def test_keypoints_lie_between_pixels_where_the_score_does() -> None:
    """A peak between two pixels is found between them; a lower one beside it is not."""
    score = torch.full((1, 1, 20, 24), 0.01)
    score[0, 0, 8, 10] = score[0, 0, 8, 11] = 0.9
    score[0, 0, 8, 12] = 0.3
    score[0, 0, 15, 5] = 0.7
    usable = torch.ones(20, 24, dtype=torch.bool)
    at = _aliked.keypoints(score, usable, count=9, least=0.05)
    single = at[(at - torch.tensor([5.0, 15.0])).norm(dim=-1) < 1]
    assert len(single) == 1
    torch.testing.assert_close(single[0], torch.tensor([5.0, 15.0]), atol=0.02, rtol=0)
    double = at[(at - torch.tensor([10.5, 8.0])).norm(dim=-1) < 1]
    assert len(double) >= 1
    assert float((double - torch.tensor([10.5, 8.0])).abs().max()) < 0.1
    usable[15, 5] = False
    assert len(_aliked.keypoints(score, usable, count=9, least=0.05)) == len(at) - 1


def glue_weights(channels: int = 16, layers: int = 2) -> dict[str, torch.Tensor]:
    """Weights of LightGlue's names and proportions, drawn at random."""
    rng = torch.Generator().manual_seed(1)
    c, p = channels, {}

    def linear(name: str, out: int, into: int) -> None:
        p[f"{name}.weight"] = torch.randn(out, into, generator=rng) / into**0.5
        p[f"{name}.bias"] = torch.randn(out, generator=rng) * 0.1

    linear("input_proj", c, 8)
    p["posenc.Wr.weight"] = torch.randn(c // _lightglue.HEADS // 2, 2, generator=rng)
    for k in range(layers):
        t = f"transformers.{k}"
        linear(f"{t}.self_attn.Wqkv", 3 * c, c)
        for name in ("self_attn.out_proj", "cross_attn.to_qk", "cross_attn.to_v", "cross_attn.to_out"):
            linear(f"{t}.{name}", c, c)
        for block in ("self_attn", "cross_attn"):
            linear(f"{t}.{block}.ffn.0", 2 * c, 2 * c)
            p[f"{t}.{block}.ffn.1.weight"], p[f"{t}.{block}.ffn.1.bias"] = torch.ones(2 * c), torch.zeros(2 * c)
            linear(f"{t}.{block}.ffn.3", c, 2 * c)
        linear(f"log_assignment.{k}.matchability", 1, c)
        linear(f"log_assignment.{k}.final_proj", c, c)
    return p


def test_lightglue_knows_no_order_and_no_place_of_the_origin() -> None:
    """Keypoints in another order give the same pairs; rotary encodings see differences of positions only."""
    rng = torch.Generator().manual_seed(2)
    at_i, at_j = torch.rand(9, 2, generator=rng), torch.rand(7, 2, generator=rng)
    d_i, d_j = torch.randn(9, 8, generator=rng), torch.randn(7, 8, generator=rng)
    p = glue_weights()
    likely = _lightglue.assignment(at_i, at_j, d_i, d_j, p)
    order = torch.randperm(9, generator=rng)
    shuffled = _lightglue.assignment(at_i[order], at_j, d_i[order], d_j, p)
    torch.testing.assert_close(shuffled, likely[order], atol=1e-6, rtol=1e-4)
    torch.testing.assert_close(_lightglue.assignment(at_j, at_i, d_j, d_i, p), likely.T, atol=1e-6, rtol=1e-4)
    torch.testing.assert_close(_lightglue.assignment(at_i + 0.7, at_j, d_i, d_j, p), likely, atol=1e-6, rtol=1e-3)
    assert not torch.allclose(_lightglue.assignment(at_i * 2, at_j, d_i, d_j, p), likely, atol=1e-6)


def test_xfeat_reads_weights_by_the_published_names() -> None:
    """Random weights of the published shapes: outputs of the right size, corners of a cell sum to less than 1."""
    rng = torch.Generator().manual_seed(3)
    widths = {"block1": [1, 4, 8, 8, 24], "block2": [24, 24, 24], "block3": [24, 64, 64, 64]}
    widths |= {"block4": [64] * 4, "block5": [64, 128, 128, 128, 64], "block_fusion": [64] * 3}
    widths |= {"heatmap_head": [64] * 3, "keypoint_head": [64] * 4}
    small = {"block3.2", "block5.3"} | {f"{h}.{k}" for h in ("heatmap_head", "keypoint_head") for k in range(3)}
    p = {}
    for name, w in widths.items():
        for k, (into, out) in enumerate(itertools.pairwise(w)):
            wide = 1 if f"{name}.{k}" in small else 3
            p[f"{name}.{k}.layer.0.weight"] = torch.randn(out, into, wide, wide, generator=rng) / (into * wide) ** 0.5
            p[f"{name}.{k}.layer.1.running_mean"] = torch.zeros(out)
            p[f"{name}.{k}.layer.1.running_var"] = torch.ones(out)
    for name, out, into in (("skip1.1", 24, 1), ("block_fusion.2", 64, 64), ("heatmap_head.2", 1, 64)):
        p[f"{name}.weight"], p[f"{name}.bias"] = torch.randn(out, into, 1, 1, generator=rng), torch.zeros(out)
    p["keypoint_head.3.weight"], p["keypoint_head.3.bias"] = torch.randn(65, 64, 1, 1, generator=rng), torch.zeros(65)
    image = torch.randint(0, 256, (1, 3, 64, 96), generator=rng)
    descriptors, corners, reliable = xfeat.network(image, p)
    assert descriptors.shape == (1, 64, 8, 12)
    assert reliable.shape == (1, 1, 8, 12)
    per_cell = corners.unflatten(2, (8, 8)).unflatten(4, (12, 8)).sum((3, 5))
    assert bool(((per_cell > 0) & (per_cell < 1 + 1e-5)).all())
    torch.testing.assert_close(descriptors.norm(dim=1), torch.ones(1, 8, 12))


def flow_weights(c: int = 8) -> dict[str, torch.Tensor]:
    """Weights of GMFlow's names and proportions, drawn at random."""
    rng = torch.Generator().manual_seed(4)
    p: dict[str, torch.Tensor] = {}

    def draw(name: str, *shape: int, bias: bool = False) -> None:
        p[f"{name}.weight"] = torch.randn(*shape, generator=rng) / max(1, int(np.prod(shape[1:]))) ** 0.5
        if bias:
            p[f"{name}.bias"] = 0.1 * torch.randn(shape[0], generator=rng)

    draw("backbone.conv1", c, 3, 7, 7)
    for layer in (1, 2, 3):
        for block in range(2):
            draw(f"backbone.layer{layer}.{block}.conv1", c, c, 3, 3)
            draw(f"backbone.layer{layer}.{block}.conv2", c, c, 3, 3)
    draw("backbone.layer2.0.downsample.0", c, c, 1, 1, bias=True)
    draw("backbone.conv2", c, c, 1, 1, bias=True)
    draw("backbone.trident_conv", c, c, 3, 3)
    for layer in range(_gmflow.LAYERS):
        for part in ("self_attn", "cross_attn_ffn"):
            for name in ("q_proj", "k_proj", "v_proj", "merge"):
                draw(f"transformer.layers.{layer}.{part}.{name}", c, c)
            draw(f"transformer.layers.{layer}.{part}.norm1", c, bias=True)
        draw(f"transformer.layers.{layer}.cross_attn_ffn.mlp.0", 8 * c, 2 * c)
        draw(f"transformer.layers.{layer}.cross_attn_ffn.mlp.2", c, 8 * c)
        draw(f"transformer.layers.{layer}.cross_attn_ffn.norm2", c, bias=True)
    for name in ("q_proj", "k_proj"):
        draw(f"feature_flow_attn.{name}", c, c, bias=True)
    draw("upsampler.0", 16, c + 2, 3, 3, bias=True)
    draw("upsampler.2", 16 * 9, 16, 1, 1, bias=True)
    return p


def test_gmflow_there_is_gmflow_back_of_the_pair_turned_round() -> None:
    first, second = torch.rand(2, 3, 64, 96, generator=torch.Generator().manual_seed(5))
    p = flow_weights()
    there, back = _gmflow.flow(first, second, p)
    assert there.shape == (2, 64, 96)
    other = _gmflow.flow(second, first, p)
    torch.testing.assert_close(other[0], back, atol=1e-3, rtol=1e-3)
    torch.testing.assert_close(other[1], there, atol=1e-3, rtol=1e-3)


def test_gmflow_matches_equal_features_wherever_they_are() -> None:
    """Every pixel with a feature of its own, all moved by (5, -3) around the frame's edge."""
    own = 200 * torch.eye(6 * 16).reshape(96, 6, 16)
    found = _gmflow._global(torch.stack([own, own.roll((-3, 5), (1, 2))]))
    rows, columns = torch.meshgrid(torch.arange(6), torch.arange(16), indexing="ij")
    expected = torch.stack([(columns + 5) % 16 - columns, (rows - 3) % 6 - rows]).float()
    torch.testing.assert_close(found[0], expected, atol=1e-3, rtol=0)


def test_gmflow_windows_that_were_rolled_together_do_not_mix() -> None:
    """Of an 8 x 8 picture in 2 x 2 windows rolled by 2, the last one holds four corners of 2 x 2 pixels each."""
    apart = _gmflow._apart(8, 8, 2, (2, 2)) < 0
    assert apart.shape == (4, 16, 16)
    assert not apart[0].any()
    assert int((~apart[3]).sum()) == 4 * 4 * 4
    x = torch.arange(2 * 8 * 8 * 3.0).reshape(2, 8, 8, 3)
    assert torch.equal(_gmflow._whole(_gmflow._windows(x, 2), 2, 8, 8), x)


# Networks of the user's own, by stand-ins of their interfaces ---------------------------------------------------------


def test_roma_adapter_by_a_stand_in(monkeypatch: pytest.MonkeyPatch) -> None:
    """A stand-in that knows the warp, in RoMa's units between the edges of the window."""
    from tumble.matching import roma

    view_i, view_j = pair()
    reach = max(_window.extent(v) for v in (view_i, view_j)) * (1 + 2 * _window.MARGIN)
    look_i, look_j = (_window.window(v, reach, roma.SIZE) for v in (view_i, view_j))

    class RoMaV2:
        def apply_setting(self, setting: str) -> None:
            assert setting == roma.SETTING

        def match(self, a: np.ndarray, b: np.ndarray) -> dict[str, torch.Tensor]:
            assert a.shape == b.shape == (roma.SIZE, roma.SIZE, 3)
            rows, columns = np.mgrid[: roma.SIZE, : roma.SIZE] + 0.5
            end = through(look_i.in_frame(np.stack([columns, rows], -1).reshape(-1, 2)))
            warp = (end - torch.tensor(look_j.corner)) * (2 / reach) - 1
            overlap = torch.full((1, roma.SIZE, roma.SIZE, 1), 0.9)
            return {"warp_AB": warp.reshape(1, roma.SIZE, roma.SIZE, 2).float(), "overlap_AB": overlap}

    monkeypatch.setitem(sys.modules, "romav2", types.SimpleNamespace(RoMaV2=RoMaV2))
    match = roma.load("cpu")(view_i, view_j)
    assert len(match) > 200
    assert float((through(match.uv_i) - match.uv_j).norm(dim=-1).max()) < 1e-3
    assert on_sure_pixels(match, view_i, view_j)


def test_mast3r_adapter_by_a_stand_in(monkeypatch: pytest.MonkeyPatch) -> None:
    """A stand-in whose descriptors are the place on the surface, so that equal points have equal ones."""
    from tumble.matching import mast3r

    monkeypatch.setattr(mast3r, "SIZE", 192)
    view_i, view_j = pair()
    reach = max(_window.extent(v) for v in (view_i, view_j)) * (1 + 2 * _window.MARGIN)
    look_i, look_j = (_window.window(v, reach, mast3r.SIZE) for v in (view_i, view_j))
    rows, columns = np.mgrid[: mast3r.SIZE, : mast3r.SIZE] + 0.5
    at = np.stack([columns, rows], -1).reshape(-1, 2)

    def described(place: torch.Tensor) -> torch.Tensor:
        ball = torch.cat([(place - 64) / 100, torch.ones(len(place), 1)], -1)
        return torch.nn.functional.normalize(ball, dim=-1).reshape(1, mast3r.SIZE, mast3r.SIZE, 3)

    def inference(pairs, network, device, batch_size, verbose) -> dict:
        ((a, b),) = pairs
        assert a["img"].shape == (1, 3, mast3r.SIZE, mast3r.SIZE)
        assert -1 <= float(a["img"].min()) < float(a["img"].max()) <= 1
        assert b["true_shape"].tolist() == [[mast3r.SIZE, mast3r.SIZE]]
        place_j = look_j.in_frame(at)
        back = torch.cat([place_j, torch.ones(len(place_j), 1)], -1).double() @ torch.from_numpy(np.linalg.inv(WARP)).T
        return {
            "pred1": {"desc": described(look_i.in_frame(at))},
            "pred2": {"desc": described((back[:, :2] / back[:, 2:]).float())},
        }

    class Network:
        @staticmethod
        def from_pretrained(where: str) -> "Network":
            assert where == mast3r.WEIGHTS
            return Network()

        def to(self, device: object) -> "Network":
            return self

        def eval(self) -> "Network":
            return self

    monkeypatch.delenv("TUMBLE_MAST3R", raising=False)
    monkeypatch.setitem(sys.modules, "mast3r", types.ModuleType("mast3r"))
    monkeypatch.setitem(sys.modules, "mast3r.model", types.SimpleNamespace(AsymmetricMASt3R=Network))
    monkeypatch.setitem(sys.modules, "dust3r", types.ModuleType("dust3r"))
    monkeypatch.setitem(sys.modules, "dust3r.inference", types.SimpleNamespace(inference=inference))
    match = mast3r.load("cpu")(view_i, view_j)
    assert len(match) > 100
    error = (through(match.uv_i) - match.uv_j).norm(dim=-1)
    # Whole pixels of the window, of which there are 1.7 to one of the frame: half the diagonal of one is 0.42. At the
    # mask's border the nearest sure pixel is farther, as far as the way back may err.
    assert float(error.quantile(0.9)) < 0.42
    assert float(error.max()) < mast3r.BACK / 1.7
    assert on_sure_pixels(match, view_i, view_j)
