"""All matchers, on an image and its copy under a known homography."""

import itertools
import sys
import types
from collections.abc import Callable

import cv2
import numpy as np
import pytest
import safetensors.torch
import torch

from tests.matching.conftest import NOT_INSTALLED, xfeat_weights
from tumble import matching
from tumble.io import weights, write_tensors
from tumble.io.files import BadFile
from tumble.io.plugins import load_plugin
from tumble.matching import _aliked, _gmflow, _lightglue, _window, aliked, match_pairs, xfeat
from tumble.matching._lightglue import DescribedKeypoints
from tumble.scene.capture import BACKGROUND, OBJECT, UNKNOWN
from tumble.scene.match import Match, View

SIZE = 128
WARP = np.array([[0.97, -0.10, 9.0], [0.09, 1.02, -6.0], [2e-4, -1e-4, 1.0]])
"""Asymmetric homography of rotation, stretch and perspective, for positions with pixel centres at +0.5."""


def texture(seed: int = 0) -> np.ndarray:
    """Coloured blobs of several sizes, so that every matcher finds correspondences."""
    rng = np.random.default_rng(seed)
    layers = [cv2.resize(rng.normal(size=(n, n, 3)), (SIZE, SIZE), interpolation=cv2.INTER_CUBIC) for n in (8, 20, 50)]
    image = sum(layers)
    return (127 + 45 * image).clip(0, 255).astype(np.uint8)


def warped(values: np.ndarray, flags: int) -> np.ndarray:
    """Image warped by WARP; OpenCV has the first pixel centre at 0."""
    half = np.array([[1, 0, 0.5], [0, 1, 0.5], [0, 0, 1.0]])
    return cv2.warpPerspective(values, np.linalg.inv(half) @ WARP @ half, (SIZE, SIZE), flags=flags)


def warped_positions(uv: torch.Tensor) -> torch.Tensor:
    """Positions mapped by WARP."""
    x = torch.cat([uv.double(), torch.ones(len(uv), 1).double()], -1) @ torch.from_numpy(WARP).T
    return (x[:, :2] / x[:, 2:]).float()


def pair() -> tuple[View, View]:
    """A round object with unknown pixels at its lower right, and the same warped by WARP."""
    rows, columns = np.mgrid[:SIZE, :SIZE]
    mask = np.where((columns - 66) ** 2 + (rows - 60) ** 2 < 48**2, OBJECT, BACKGROUND).astype(np.uint8)
    mask[(rows > 80) & (columns > 70)] = UNKNOWN
    image = texture()
    image[mask != OBJECT] = 0
    views = (image, mask), (warped(image, cv2.INTER_CUBIC), warped(mask, cv2.INTER_NEAREST))
    i, j = (View(n, torch.from_numpy(im), torch.from_numpy(m)) for n, (im, m) in zip((7, 3), views, strict=True))
    return i, j


def on_interior_pixels(match: Match, view_i: View, view_j: View) -> bool:
    """Whether both ends of all correspondences lie on interior pixels of the object."""
    return all(
        bool(_window.interior_pixels(view.mask)[row, column])
        for view, uv in ((view_i, match.uv_i), (view_j, match.uv_j))
        for column, row in uv.long().tolist()
    )


def test_a_known_warp_is_recovered(matcher: matching.Matcher) -> None:
    view_i, view_j = pair()
    match = matcher(view_i, view_j)
    assert (match.i, match.j) == (7, 3)
    assert len(match) >= 20
    error = (warped_positions(match.uv_i) - match.uv_j).norm(dim=-1)
    assert float(error.median()) < 1
    assert float((error < 2).float().mean()) > 0.8
    assert 0 <= float(match.confidence.min()) <= float(match.confidence.max()) <= 1
    # Correspondences are spread over at least half the object's width.
    assert bool((match.uv_i.amax(0) - match.uv_i.amin(0) > 45).all())


def test_correspondences_are_unbiased(matcher: matching.Matcher) -> None:
    """A wrong pixel convention would shift the mean over many points by a quarter or half of a pixel."""
    view_i, view_j = pair()
    match = matcher(view_i, view_j)
    error = warped_positions(match.uv_i) - match.uv_j
    inlier = error.norm(dim=-1) < 2
    assert float(error[inlier].mean(0).abs().max()) < 0.15


def test_correspondences_lie_on_interior_pixels(matcher: matching.Matcher) -> None:
    """None lies on background, unknown pixels or the border of the mask, in either frame."""
    view_i, view_j = pair()
    assert on_interior_pixels(matcher(view_i, view_j), view_i, view_j)


def test_a_static_background_has_no_effect(matcher: matching.Matcher) -> None:
    view_i, view_j = pair()
    static = torch.from_numpy(texture(seed=5))
    views = [
        View(v.number, torch.where(v.mask[..., None] == OBJECT, v.image, static), v.mask) for v in (view_i, view_j)
    ]
    match = matcher(*views)
    error = (warped_positions(match.uv_i) - match.uv_j).norm(dim=-1)
    assert float(error.median()) < 1
    plain = matcher(view_i, view_j)
    assert abs(len(match) - len(plain)) <= 0.1 * len(plain), (
        "the number of correspondences does not depend on the background"
    )


def test_without_an_object_the_match_is_empty(matcher: matching.Matcher) -> None:
    view_i, view_j = pair()
    empty = View(3, view_j.image, torch.full_like(view_j.mask, UNKNOWN))
    assert len(matcher(view_i, empty)) == 0
    assert len(matcher(empty, View(4, view_i.image, view_i.mask))) == 0


def test_an_object_of_one_colour_is_no_error(matcher: matching.Matcher) -> None:
    """It has no keypoints; flow may call it still."""
    mask = pair()[0].mask
    image = torch.full((SIZE, SIZE, 3), 90, dtype=torch.uint8)
    match = matcher(View(0, image, mask), View(1, image, mask))
    assert torch.equal(match.uv_i, match.uv_j)


def test_swapped_views_give_equivalent_matches(matcher: matching.Matcher) -> None:
    view_i, view_j = pair()
    forward, backward = matcher(view_i, view_j), matcher(view_j, view_i).reversed()
    assert (backward.i, backward.j) == (forward.i, forward.j)
    error = (warped_positions(backward.uv_i) - backward.uv_j).norm(dim=-1)
    assert float(error.median()) < 1
    # A dense matcher starts from a grid in the other frame: about as many points, but not the same ones.
    assert abs(len(forward) - len(backward)) <= 0.15 * len(forward)


def test_threads_do_not_change_the_matches(monkeypatch: pytest.MonkeyPatch) -> None:
    """Nor does OpenCV's own number of threads, on which flow would depend, and which is restored."""
    view_i, view_j = pair()
    views = [view_i, view_j, View(5, view_j.image.flip(1), view_j.mask.flip(1)), View(6, view_i.image, view_i.mask)]
    pairs = list(itertools.combinations(range(4), 2))
    before, found = cv2.getNumThreads(), []
    for threads in (1, 3):
        monkeypatch.setattr(torch, "get_num_threads", lambda n=threads: n)
        cv2.setNumThreads(threads)
        found.append(match_pairs(views, pairs, "mixed"))
        assert cv2.getNumThreads() == threads
    cv2.setNumThreads(before)
    assert [(m.i, m.j) for m in found[0]] == [(views[i].number, views[j].number) for i, j in pairs]
    for one, several in zip(*found, strict=True):
        assert (one.i, one.j) == (several.i, several.j)
        for name in ("uv_i", "uv_j", "confidence"):
            assert torch.equal(getattr(one, name), getattr(several, name))


def test_sift_is_exactly_symmetric() -> None:
    view_i, view_j = pair()
    match = load_plugin("matching", "sift").load("cpu")
    forward, backward = match(view_i, view_j), match(view_j, view_i).reversed()
    rows = [torch.cat([m.uv_i, m.uv_j, m.confidence[:, None]], 1) for m in (forward, backward)]
    torch.testing.assert_close(*(r[np.lexsort(r.numpy().T)] for r in rows))


def test_keypoints_are_where_the_blobs_are() -> None:
    """A shift that both frames have in common would move all matches away from the silhouettes."""
    rng = np.random.default_rng(0)
    rows, columns = np.mgrid[:SIZE, :SIZE] + 0.5
    centres = (np.stack(np.meshgrid(*[np.arange(30, 100, 14)] * 2), -1) + rng.uniform(-3, 3, (5, 5, 2))).reshape(-1, 2)
    squared = (columns[..., None] - centres[:, 0]) ** 2 + (rows[..., None] - centres[:, 1]) ** 2
    brightness = 60 + np.exp(-squared / (2 * rng.uniform(1.5, 2.5, 25) ** 2)) @ rng.uniform(90, 180, 25)
    image = torch.from_numpy(np.repeat(brightness[..., None].clip(0, 255).astype(np.uint8), 3, 2))
    mask = torch.full((SIZE, SIZE), OBJECT, dtype=torch.uint8)
    found = load_plugin("matching", "sift").load("cpu")(View(0, image, mask), View(1, image, mask)).uv_i.double()
    nearest = torch.cdist(torch.from_numpy(centres), found)
    # Some blobs have no keypoint, or one between them and their neighbours.
    seen = nearest.amin(1) < 1.5
    assert seen.sum() > 15
    offset = found[nearest.argmin(1)] - torch.from_numpy(centres)
    assert offset[seen].mean(0).abs().max() < 0.1


# Windows --------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("size", [40, 300])
def test_positions_in_windows_map_to_the_frame(size: int) -> None:
    """The centroid of a bright dot maps to its position in the frame, for enlarged and reduced windows."""
    image = np.zeros((SIZE, SIZE, 3), np.float32)
    rows, columns = np.mgrid[:SIZE, :SIZE] + 0.5
    image += 255 * np.exp(-((columns - 61.3) ** 2 + (rows - 44.8) ** 2) / (2 * 3.0**2))[..., None]
    mask = torch.zeros(SIZE, SIZE, dtype=torch.uint8)
    mask[20:90, 30:100] = OBJECT
    window = _window.crop_window(View(0, torch.from_numpy(image.astype(np.uint8)), mask), 80.0, size)
    # Only the dot, without the fill around the object.
    brightness = window.rgb[..., 0].astype(np.float64) * (window.rgb[..., 0] > 20)
    rows, columns = np.mgrid[:size, :size] + 0.5
    centroid = np.array([[(brightness * columns).sum(), (brightness * rows).sum()]]) / brightness.sum()
    # The threshold crops the dot asymmetrically in a window of 40 x 40 pixels, by a fiftieth of a pixel.
    torch.testing.assert_close(window.in_frame(centroid), torch.tensor([[61.3, 44.8]]), atol=0.06, rtol=0)


def test_shading_and_exposure_hardly_change_normalised_grey() -> None:
    """The same texture under light that increases threefold across the object.

    Code values differ by 60 and more, normalised grey by a few of its 45 per standard deviation.
    """
    view, _ = pair()
    columns = torch.arange(SIZE) / SIZE
    shaded = (view.image * (0.4 + 0.8 * columns)[None, :, None]).to(torch.uint8)
    plain, other = (_window.crop_window(View(0, image, view.mask), 110.0, 384) for image in (view.image, shaded))
    usable = plain.usable
    assert np.abs(plain.rgb[usable].astype(float) - other.rgb[usable]).mean() > 25
    assert np.abs(plain.grey[usable].astype(float) - other.grey[usable]).mean() < 8


def test_interior_pixels_exclude_the_border_but_not_the_edge_of_the_frame() -> None:
    mask = torch.zeros(128, 128, dtype=torch.uint8)
    mask[50:, 20:80] = OBJECT
    mask[50:, 60:80] = UNKNOWN
    interior = _window.interior_pixels(mask)
    rows, columns = np.nonzero(interior)
    assert (rows.min(), rows.max(), columns.min(), columns.max()) == (52, 127, 22, 57)


def test_windows_have_no_contour_of_the_object() -> None:
    """Around a grey object on white everything is grey."""
    view_i, _ = pair()
    image = torch.where(view_i.mask[..., None] == OBJECT, 90, 255).to(torch.uint8).expand(-1, -1, 3).contiguous()
    window = _window.crop_window(View(0, image, view_i.mask), 110.0, 220)
    assert int(window.rgb.min()) >= 89
    assert int(window.rgb.max()) <= 91


# The cache ------------------------------------------------------------------------------------------------------------


def same(a: Match, b: Match) -> bool:
    """Whether two matches are identical."""
    return (a.i, a.j) == (b.i, b.j) and all(
        torch.equal(getattr(a, name), getattr(b, name)) for name in ("uv_i", "uv_j", "confidence")
    )


def forbid(monkeypatch: pytest.MonkeyPatch, name: str) -> None:
    """Let the loading of a matcher fail."""

    def load(device: object) -> Callable:
        raise AssertionError("must not be loaded")

    monkeypatch.setattr(load_plugin("matching", name), "load", load)


def test_cached_matches_are_not_computed_again(tmp_path, monkeypatch: pytest.MonkeyPatch) -> None:
    views = list(pair())
    first = match_pairs(views, [(0, 1), (1, 0)], "dis", cache=tmp_path)
    assert len(list(tmp_path.iterdir())) == 2
    forbid(monkeypatch, "dis")
    again = match_pairs(views, [(0, 1), (1, 0)], "dis", cache=tmp_path)
    assert all(same(a, b) for a, b in zip(first, again, strict=True))


def test_the_cache_is_independent_of_frame_numbers(tmp_path, monkeypatch: pytest.MonkeyPatch) -> None:
    view_i, view_j = pair()
    match_pairs([view_i, view_j], [(0, 1)], "dis", cache=tmp_path)
    forbid(monkeypatch, "dis")
    renumbered = [View(90, view_i.image, view_i.mask), View(91, view_j.image, view_j.mask)]
    assert [(m.i, m.j) for m in match_pairs(renumbered, [(0, 1)], "dis", cache=tmp_path)] == [(90, 91)]


def test_other_masks_and_settings_have_other_files(tmp_path, monkeypatch: pytest.MonkeyPatch) -> None:
    view_i, view_j = pair()
    match_pairs([view_i, view_j], [(0, 1)], "mixed", cache=tmp_path)
    mask = view_j.mask.clone()
    mask[60, 60] = UNKNOWN
    match_pairs([view_i, View(3, view_j.image, mask)], [(0, 1)], "mixed", cache=tmp_path)
    assert len(list(tmp_path.iterdir())) == 2
    monkeypatch.setattr(load_plugin("matching", "dis"), "MAX_CYCLE_ERROR", 1.0)
    match_pairs([view_i, view_j], [(0, 1)], "mixed", cache=tmp_path)
    assert len(list(tmp_path.iterdir())) == 3, "mixed includes dis, whose settings changed"


def test_the_error_of_a_damaged_cache_names_the_fix(tmp_path) -> None:
    views = list(pair())
    match_pairs(views, [(0, 1)], "dis", cache=tmp_path)
    (path,) = tmp_path.iterdir()
    content = bytearray(path.read_bytes())
    content[-1] ^= 1
    path.write_bytes(content)
    with pytest.raises(BadFile, match=r"does not match its checksum \(delete it, it is computed again\)"):
        match_pairs(views, [(0, 1)], "dis", cache=tmp_path)
    path.write_bytes(b"no tensors")
    with pytest.raises(BadFile, match="delete it"):
        match_pairs(views, [(0, 1)], "dis", cache=tmp_path)
    write_tensors(path, {"uv_i": torch.zeros(1, 2)}, {})
    with pytest.raises(BadFile, match="is not a match"):
        match_pairs(views, [(0, 1)], "dis", cache=tmp_path)


def test_the_error_of_an_unknown_matcher_lists_the_known_ones() -> None:
    with pytest.raises(ValueError, match=r"dis, .*mixed, .*sift"):
        match_pairs(list(pair()), [(0, 1)], "eyes")


# Networks without their weights ---------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", sorted(weights.SOURCES))
def test_the_error_of_missing_weights_names_the_command(name: str, tmp_path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    with pytest.raises(BadFile, match=f"tumble weights get {name}"):
        load_plugin("matching", name).load("cpu")


@pytest.mark.parametrize("name", sorted(NOT_INSTALLED))
def test_the_error_of_a_missing_package_names_the_matcher(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    for package in ("romav2", "mast3r", "mast3r.model", "dust3r", "dust3r.inference"):
        monkeypatch.setitem(sys.modules, package, None)
    with pytest.raises(ModuleNotFoundError, match=f"the matcher {name} needs"):
        load_plugin("matching", name).load("cpu")


def test_a_deformable_convolution_without_offsets_is_a_convolution() -> None:
    rng = torch.Generator().manual_seed(0)
    x, kernel = torch.randn(1, 3, 7, 9, generator=rng), torch.randn(4, 3, 3, 3, generator=rng)
    out = _aliked.deformable(x, torch.zeros(1, 18, 7, 9), kernel)
    torch.testing.assert_close(out, torch.nn.functional.conv2d(x, kernel, padding=1), atol=1e-5, rtol=1e-5)


def test_a_deformable_convolution_moves_each_tap_independently() -> None:
    """The kernel's third tap, in its top right corner, is moved 2 down and 1.5 left for one pixel."""
    x = torch.arange(63.0).reshape(1, 1, 7, 9)
    kernel = torch.zeros(1, 1, 3, 3)
    kernel[0, 0, 0, 2] = 1.0
    offsets = torch.zeros(1, 18, 7, 9)
    offsets[0, 4, 3, 4], offsets[0, 5, 3, 4] = 2.0, -1.5
    out = _aliked.deformable(x, offsets, kernel)
    # Row 3 - 1 + 2 = 4, column 4 + 1 - 1.5 = 3.5; without offsets row 1, column 6 for pixel (2, 5).
    assert float(out[0, 0, 3, 4]) == pytest.approx(4 * 9 + 3.5, abs=1e-4)
    assert float(out[0, 0, 2, 5]) == pytest.approx(1 * 9 + 6, abs=1e-4)


def test_pixel_features_and_scores_are_those_of_enlarged_features() -> None:
    """As published: features of all resolutions are enlarged and joined, and the score is computed from them."""
    tensors = safetensors.torch.load_file(aliked.WEIGHTS)
    p = {name.removeprefix("aliked."): x.float() for name, x in tensors.items() if name.startswith("aliked.")}
    levels, score = _aliked.dense(torch.rand(1, 3, 32, 64, generator=torch.Generator().manual_seed(0)), p)
    large = [torch.nn.functional.interpolate(x, (32, 64), mode="bilinear", align_corners=True) for x in levels]
    joined = torch.cat(large, 1)
    y = torch.nn.functional.conv2d(joined, p["score_head.0.weight"])
    for k in (2, 4, 6):
        y = torch.nn.functional.conv2d(torch.nn.functional.selu(y), p[f"score_head.{k}.weight"], padding=1)
    torch.testing.assert_close(score, y.sigmoid(), atol=1e-5, rtol=1e-4)
    pixel = torch.tensor([[[0, 0], [63, 31], [17, 5]], [[-1, 3], [64, 3], [3, 32]]])
    found = _aliked.pixel_features(levels, pixel)
    column, row = pixel[0].T
    unit = torch.nn.functional.normalize(joined, dim=1)
    torch.testing.assert_close(found[0], unit[0, :, row, column].T, atol=1e-5, rtol=1e-4)
    assert (found[1] == 0).all()
    at = torch.tensor([[[17.25, 5.5], [62.9, 30.1], [-0.4, 12.0]]])
    between = _aliked._sample(unit, at[None])[0, :, 0].T
    torch.testing.assert_close(_aliked.features_at(levels, at)[0], between, atol=1e-5, rtol=1e-4)


def test_keypoints_have_sub_pixel_positions() -> None:
    """A maximum between two pixels gives a keypoint between them; a lower score beside it gives none."""
    score = torch.full((1, 1, 20, 24), 0.01)
    score[0, 0, 8, 10] = score[0, 0, 8, 11] = 0.9
    score[0, 0, 8, 12] = 0.3
    score[0, 0, 15, 5] = 0.7
    usable = torch.ones(20, 24, dtype=torch.bool)
    at = _aliked.keypoints(score, usable, max_count=9, min_score=0.05)
    single = at[(at - torch.tensor([5.0, 15.0])).norm(dim=-1) < 1]
    assert len(single) == 1
    torch.testing.assert_close(single[0], torch.tensor([5.0, 15.0]), atol=0.02, rtol=0)
    double = at[(at - torch.tensor([10.5, 8.0])).norm(dim=-1) < 1]
    assert len(double) >= 1
    assert float((double - torch.tensor([10.5, 8.0])).abs().max()) < 0.1
    usable[15, 5] = False
    assert len(_aliked.keypoints(score, usable, max_count=9, min_score=0.05)) == len(at) - 1


def glue_weights(channels: int = 16, layers: int = 2, outputs: tuple[int, ...] = (1,)) -> dict[str, torch.Tensor]:
    """Random weights with the names and shapes of LightGlue, with outputs of some layers."""
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
    for k in outputs:
        linear(f"log_assignment.{k}.matchability", 1, c)
        linear(f"log_assignment.{k}.final_proj", c, c)
    return p


def test_lightglue_is_independent_of_order_and_origin() -> None:
    """Keypoints in another order give the same pairs; rotary encodings depend on differences of positions only."""
    rng = torch.Generator().manual_seed(2)
    at_i, at_j = torch.rand(9, 2, generator=rng), torch.rand(7, 2, generator=rng)
    d_i, d_j = torch.randn(9, 8, generator=rng), torch.randn(7, 8, generator=rng)
    i, j, p = DescribedKeypoints(at_i, d_i), DescribedKeypoints(at_j, d_j), glue_weights()
    probability = _lightglue.assignment(i, j, p)
    order = torch.randperm(9, generator=rng)
    shuffled = _lightglue.assignment(DescribedKeypoints(at_i[order], d_i[order]), j, p)
    torch.testing.assert_close(shuffled, probability[order], atol=1e-6, rtol=1e-4)
    torch.testing.assert_close(_lightglue.assignment(j, i, p), probability.T, atol=1e-6, rtol=1e-4)
    shifted, larger = (_lightglue.assignment(DescribedKeypoints(at, d_i), j, p) for at in (at_i + 0.7, at_i * 2))
    torch.testing.assert_close(shifted, probability, atol=1e-6, rtol=1e-3)
    assert not torch.allclose(larger, probability, atol=1e-6)


def test_lightglue_gives_up_pairs_that_an_earlier_output_calls_hopeless(monkeypatch: pytest.MonkeyPatch) -> None:
    """Random features match about nowhere: the pair is given up. Without that limit the last output decides alone."""
    rng = torch.Generator().manual_seed(4)
    at, d = torch.rand(2, 9, 2, generator=rng), torch.randn(2, 9, 8, generator=rng)
    pair = DescribedKeypoints(at[0], d[0]), DescribedKeypoints(at[1], d[1])
    both, last = glue_weights(outputs=(1, 0)), glue_weights(outputs=(1,))
    expected = _lightglue.assignment(*pair, last)
    assert float(expected.max()) > 0
    assert float(_lightglue.assignment(*pair, both).max()) == 0
    assert float(_lightglue.first_assignment(*pair, both).max()) > 0
    monkeypatch.setattr(_lightglue, "MIN_EXPECTED", 0.0)
    assert torch.equal(_lightglue.assignment(*pair, both), expected)


def test_xfeat_uses_the_published_names_and_shapes_of_weights() -> None:
    """With random weights, outputs have the right size, and keypoint probabilities of a cell sum to less than 1."""
    image = torch.randint(0, 256, (1, 3, 64, 96), generator=torch.Generator().manual_seed(5))
    descriptors, keypoint_score, reliability = xfeat.network(image, xfeat_weights())
    assert descriptors.shape == (1, 64, 8, 12)
    assert reliability.shape == (1, 1, 8, 12)
    per_cell = keypoint_score.unflatten(2, (8, 8)).unflatten(4, (12, 8)).sum((3, 5))
    assert bool(((per_cell > 0) & (per_cell < 1 + 1e-5)).all())
    torch.testing.assert_close(descriptors.norm(dim=1), torch.ones(1, 8, 12))


def flow_weights(c: int = 8) -> dict[str, torch.Tensor]:
    """Random weights with the names and shapes of GMFlow."""
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


def test_gmflow_of_swapped_images_is_the_swapped_flow() -> None:
    first, second = torch.rand(2, 3, 64, 96, generator=torch.Generator().manual_seed(5))
    p = flow_weights()
    forward, backward = _gmflow.flow(first, second, p)
    assert forward.shape == (2, 64, 96)
    swapped = _gmflow.flow(second, first, p)
    torch.testing.assert_close(swapped[0], backward, atol=1e-3, rtol=1e-3)
    torch.testing.assert_close(swapped[1], forward, atol=1e-3, rtol=1e-3)


def test_gmflow_matches_equal_features_over_any_distance() -> None:
    """Every pixel has a unique feature, and all are shifted cyclically by (5, -3)."""
    unique = 200 * torch.eye(6 * 16).reshape(96, 6, 16)
    found = _gmflow._match_globally(torch.stack([unique, unique.roll((-3, 5), (1, 2))]))
    rows, columns = torch.meshgrid(torch.arange(6), torch.arange(16), indexing="ij")
    expected = torch.stack([(columns + 5) % 16 - columns, (rows - 3) % 6 - rows]).float()
    torch.testing.assert_close(found[0], expected, atol=1e-3, rtol=0)


def test_gmflow_masks_attention_across_the_shift() -> None:
    """Of an 8 x 8 image in 2 x 2 windows shifted by 2, the last one holds four corners of 2 x 2 pixels each."""
    masked = _gmflow._shift_mask(8, 8, 2, (2, 2)) < 0
    assert masked.shape == (4, 16, 16)
    assert not masked[0].any()
    assert int((~masked[3]).sum()) == 4 * 4 * 4
    x = torch.arange(2 * 8 * 8 * 3.0).reshape(2, 8, 8, 3)
    assert torch.equal(_gmflow._merge(_gmflow._split(x, 2), 2, 8, 8), x)


# Networks installed by the user, by mocks of their interfaces ---------------------------------------------------------


def test_roma_adapter_with_a_mock(monkeypatch: pytest.MonkeyPatch) -> None:
    """A mock that returns the true warp, in RoMa's units between the edges of the window."""
    from tumble.matching import roma

    view_i, view_j = pair()
    width = max(_window.extent(v) for v in (view_i, view_j)) * (1 + 2 * _window.MARGIN)
    window_i, window_j = (_window.crop_window(v, width, roma.SIZE) for v in (view_i, view_j))

    class RoMaV2:
        def apply_setting(self, setting: str) -> None:
            assert setting == roma.SETTING

        def match(self, a: np.ndarray, b: np.ndarray) -> dict[str, torch.Tensor]:
            assert a.shape == b.shape == (roma.SIZE, roma.SIZE, 3)
            rows, columns = np.mgrid[: roma.SIZE, : roma.SIZE] + 0.5
            end = warped_positions(window_i.in_frame(np.stack([columns, rows], -1).reshape(-1, 2)))
            warp = (end - torch.tensor(window_j.corner)) * (2 / width) - 1
            overlap = torch.full((1, roma.SIZE, roma.SIZE, 1), 0.9)
            return {"warp_AB": warp.reshape(1, roma.SIZE, roma.SIZE, 2).float(), "overlap_AB": overlap}

    monkeypatch.setitem(sys.modules, "romav2", types.SimpleNamespace(RoMaV2=RoMaV2))
    match = roma.load("cpu")(view_i, view_j)
    assert len(match) > 200
    assert float((warped_positions(match.uv_i) - match.uv_j).norm(dim=-1).max()) < 1e-3
    assert on_interior_pixels(match, view_i, view_j)


def test_mast3r_adapter_with_a_mock(monkeypatch: pytest.MonkeyPatch) -> None:
    """A mock whose descriptors encode the position on the surface, so that equal points have equal descriptors."""
    from tumble.matching import mast3r

    monkeypatch.setattr(mast3r, "SIZE", 192)
    view_i, view_j = pair()
    width = max(_window.extent(v) for v in (view_i, view_j)) * (1 + 2 * _window.MARGIN)
    window_i, window_j = (_window.crop_window(v, width, mast3r.SIZE) for v in (view_i, view_j))
    rows, columns = np.mgrid[: mast3r.SIZE, : mast3r.SIZE] + 0.5
    at = np.stack([columns, rows], -1).reshape(-1, 2)

    def described(uv: torch.Tensor) -> torch.Tensor:
        direction = torch.cat([(uv - 64) / 100, torch.ones(len(uv), 1)], -1)
        return torch.nn.functional.normalize(direction, dim=-1).reshape(1, mast3r.SIZE, mast3r.SIZE, 3)

    def inference(pairs, network, device, batch_size, verbose) -> dict:
        ((a, b),) = pairs
        assert a["img"].shape == (1, 3, mast3r.SIZE, mast3r.SIZE)
        assert -1 <= float(a["img"].min()) < float(a["img"].max()) <= 1
        assert b["true_shape"].tolist() == [[mast3r.SIZE, mast3r.SIZE]]
        uv_j = window_j.in_frame(at)
        unwarped = torch.cat([uv_j, torch.ones(len(uv_j), 1)], -1).double() @ torch.from_numpy(np.linalg.inv(WARP)).T
        return {
            "pred1": {"desc": described(window_i.in_frame(at))},
            "pred2": {"desc": described((unwarped[:, :2] / unwarped[:, 2:]).float())},
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
    error = (warped_positions(match.uv_i) - match.uv_j).norm(dim=-1)
    # Positions are rounded to pixels of the window, 1.7 per pixel of the frame, with a half diagonal of 0.42. At the
    # border of the mask the nearest usable pixel is farther away, up to the largest cycle error.
    assert float(error.quantile(0.9)) < 0.42
    assert float(error.max()) < mast3r.MAX_CYCLE_ERROR / 1.7
    assert on_interior_pixels(match, view_i, view_j)
