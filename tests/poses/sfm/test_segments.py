"""Poses of an object that a hand hides in part, and for some frames altogether: the hand is an unknown half of it."""

from dataclasses import replace

import pytest
import torch

from tests.lopsided import Tumble, truth, tumbling
from tumble.evaluation import metrics
from tumble.maths import SE3, SO3
from tumble.poses.sfm import segments, stage
from tumble.poses.sfm.adjustment import Windows
from tumble.poses.sfm.observations import is_hidden, on_object, shown
from tumble.poses.sfm.partial import Observed, Partial, cut
from tumble.poses.sfm.tracks import NO_TRACKS, Tracks, gather_keypoints
from tumble.scene import BACKGROUND, OBJECT, UNKNOWN, Capture, Match, Trajectory

QUICK = stage.Config(window_scales=(3.0, 1.0, 0.5), relocalized_scales=(1.0, 0.5))
N = 30
REGRASP = (14, 15)
"""Frames in which the hand covers the object."""


def hidden(scene: Tumble) -> Capture:
    """The right half of the object, as seen in the image, is unknown; during the change of grip most of it."""
    masks = scene.capture.masks.clone()
    for k, mask in enumerate(masks):
        column = torch.nonzero(mask == OBJECT)[:, 1].float()
        start = column.quantile(0.15 if k in REGRASP else 0.5)
        mask[(mask == OBJECT) & (torch.arange(mask.shape[1]) >= start)] = UNKNOWN
    return replace(scene.capture, masks=masks)


def matched(scene: Tumble, capture: Capture, pairs: list[tuple[int, int]]) -> list[Match]:
    """Matches of all that is not background, but none of the frames of the change of grip with their neighbours."""
    rng, found = torch.Generator().manual_seed(0), []
    for i, j in pairs:
        match = scene.match(i, j, rng)
        across = i in REGRASP or j in REGRASP or (i < REGRASP[0] and j > REGRASP[1] and j - i < 6)
        found.append(match.select(torch.arange(0 if across else len(match))))
    return found


@pytest.fixture(scope="module")
def scene() -> Tumble:
    return tumbling(N, points=300)


@pytest.fixture(scope="module")
def inputs(scene: Tumble) -> stage.Inputs:
    near = [(t - k, t) for k in (1, 2, 4) for t in range(k, N)]
    return stage.gather(hidden(scene), matched(scene, hidden(scene), near), hidden=True)


def start(scene: Tumble) -> torch.Tensor:
    """Rotations 25 degrees off."""
    turn = SO3.exp(0.25 * torch.randn(N, 3, generator=torch.Generator().manual_seed(3), dtype=torch.float64))
    return scene.T_cam_obj.rotation.matrix().double() @ turn.matrix()


@pytest.fixture(scope="module")
def posed(scene: Tumble, inputs: stage.Inputs) -> tuple[Partial, stage.Inputs]:
    """The poses that segments give, from rotations 25 degrees off."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(segments, "MAX_MISSING", len(REGRASP) / N)
        patch.setattr(segments, "_matched", lambda inputs, pairs, matcher: matched(scene, inputs.capture, pairs))
        part, tracks = segments.segmented_poses(QUICK, inputs, start(scene), torch.Generator().manual_seed(0))
    assert part is not None
    assert set(tracks.frame.tolist()) == set(part.frames)
    return part, inputs


def test_segments_before_and_after_a_change_of_grip_are_joined(scene: Tumble, posed: tuple) -> None:
    part, _ = posed
    assert set(range(N)) - set(part.frames) == set(REGRASP)
    T = SE3.from_rotation_matrix(part.R.float())
    scores = metrics.rotation_scores(Trajectory(T, "camera"), truth(scene).select(list(part.frames)))
    assert scores["rotation_median_degrees"] < 1.0
    assert scores["rotation_below_5_percent"] == 100


@pytest.mark.parametrize("first", [N - 1, N - 4])
def test_the_network_is_asked_only_where_sift_leaves_frames_out(
    scene: Tumble, inputs: stage.Inputs, first: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    asked: list[str] = []

    def matches(inputs: stage.Inputs, pairs: list[tuple[int, int]], matcher: str) -> list[Match]:
        asked.append(matcher)
        if matcher != "sift":
            assert all(max(pair) >= first for pair in pairs)  # one of both frames has no pose
        return matched(scene, inputs.capture, pairs[:40])

    def understood(
        cfg: object, given: stage.Inputs, wide: list[Match], R: torch.Tensor, rng: object, *, cautious: bool
    ) -> tuple[list[Partial], Tracks]:
        assert cautious == (asked == ["sift"])
        found = first if cautious else N
        if not cautious:  # The network's matches are added to those of neighbouring frames and to SIFT's.
            assert sum(map(len, given.all_matches)) > sum(map(len, inputs.all_matches))
            assert len(wide) == len({(match.i, match.j) for match in wide})
        return [Partial(tuple(range(found)), R[:found], R[:found, 0])], inputs.tracks

    monkeypatch.setattr(segments, "_matched", matches)
    monkeypatch.setattr(segments, "_understood", understood)
    part, _ = segments.segmented_poses(QUICK, inputs, start(scene), torch.Generator().manual_seed(0))
    assert part is not None
    assert (len(part), asked) == (
        (N - 1, ["sift"]) if first == N - 1 else (N, ["sift", "aliked", *2 * ["aliked_turned"]])
    )


@pytest.mark.parametrize(("sizes", "kept"), [([9, 24, 30], 24), ([9, 12, 10, 11], 12), ([5, 4, 6, 4, 30], 8)])
def test_parts_are_joined_again_until_enough_frames_have_a_pose(
    sizes: list[int], kept: int, scene: Tumble, inputs: stage.Inputs, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Three quarters of 30 are 23; the largest result counts, also that of before the network."""
    R, calls = start(scene), iter(sizes)

    def understood(*_: object, cautious: bool) -> tuple[list[Partial], Tracks]:
        n = 8 if cautious else next(calls)
        return [Partial(tuple(range(n)), R[:n], R[:n, 0])], inputs.tracks

    monkeypatch.setattr(segments, "_matched", lambda *_: [])
    monkeypatch.setattr(segments, "_understood", understood)
    part, _ = segments.segmented_poses(QUICK, inputs, R, torch.Generator().manual_seed(0))
    assert part is not None
    assert len(part) == kept
    assert len(list(calls)) == len(sizes) - (2 if kept == 24 else segments.ATTEMPTS)


def test_the_network_matches_no_pair_of_frames_of_one_part(
    scene: Tumble, inputs: stage.Inputs, monkeypatch: pytest.MonkeyPatch
) -> None:
    R, asked = start(scene), {"sift": [], "aliked": [], "aliked_turned": []}
    halves = [Partial(tuple(frames), R[frames], R[frames, 0]) for frames in (range(15, N), range(14))]

    def matches(inputs: stage.Inputs, pairs: list[tuple[int, int]], matcher: str) -> list[Match]:
        asked[matcher] += pairs
        return matched(scene, inputs.capture, pairs[:40])

    monkeypatch.setattr(segments, "_matched", matches)
    monkeypatch.setattr(segments, "_understood", lambda *_, **__: (halves, inputs.tracks))
    segments.segmented_poses(QUICK, inputs, R, torch.Generator().manual_seed(0))
    near, far = asked["aliked"], asked["aliked_turned"]
    assert all(i < 14 <= j or 14 in (i, j) for i, j in near + far)
    assert (13, 15) in near
    assert any(i < 14 < j for i, j in far)
    assert all(j - i > segments.NEAR for i, j in far)


def test_frames_without_a_pose_are_lost_and_stay_out_of_the_adjustment(posed: tuple) -> None:
    part, inputs = posed
    state = stage.init(QUICK, inputs, torch.Generator().manual_seed(0))
    R, t = state.params.R.clone(), state.params.t.clone()
    R[list(part.frames)], t[list(part.frames)] = part.R, part.t
    state.params, state.memory["posed"] = replace(state.params, R=R, t=t), torch.zeros(N, dtype=torch.bool)
    state.memory["posed"][list(part.frames)] = True
    moved, _ = stage.adjust_all(QUICK, inputs, state, 1.0)
    assert torch.equal(moved.R[list(REGRASP)], R[list(REGRASP)])
    assert not torch.equal(moved.R[list(part.frames)], R[list(part.frames)])
    assert torch.nonzero(stage.finish(QUICK, inputs, state).quality.lost)[:, 0].tolist() == list(REGRASP)


def test_only_a_wide_unknown_region_hides_the_object(scene: Tumble) -> None:
    """Masks of films have narrow unknown bands along the silhouette."""
    masks = scene.capture.masks.clone()
    inner = torch.nn.functional.avg_pool2d((masks == OBJECT).float(), 3, 1, 1) == 1
    masks[(masks == OBJECT) & ~inner] = UNKNOWN
    assert not is_hidden(scene.capture.masks)
    assert not is_hidden(masks)
    assert is_hidden(hidden(scene).masks)


def test_what_hides_the_object_is_matched_as_well(scene: Tumble) -> None:
    capture = shown(hidden(scene))
    assert torch.equal(capture.masks == OBJECT, scene.capture.masks == OBJECT)
    assert not (capture.masks == UNKNOWN).any()


def test_doubted_background_has_contours_beside_it_but_stays_unknown(scene: Tumble) -> None:
    """It is unknown, and black in images of a photo that is not."""
    certain = hidden(scene)
    photos = torch.where(certain.masks[..., None] == BACKGROUND, 200, certain.images)
    certain = replace(certain.with_masks(certain.masks), full_images=photos)
    upper = torch.arange(certain.masks.shape[1])[:, None] < certain.masks.shape[1] // 2
    masks = certain.masks.masked_fill(upper & (certain.masks == BACKGROUND), UNKNOWN)
    doubted = replace(certain, masks=masks)
    found, same = (stage.gather(each, [], hidden=True) for each in (doubted, certain))
    assert torch.equal(found.contours.reliable, same.contours.reliable)
    assert torch.equal(found.contours.vertices, same.contours.vertices)
    assert same.contours.reliable.any()
    assert ((found.capture.masks == UNKNOWN) == (masks == UNKNOWN)).float().mean() > 0.98, "but for scraps"
    assert torch.equal(shown(doubted).masks, shown(certain).masks)
    seen = replace(doubted, images=photos)
    without = stage.gather(seen, [], hidden=True).contours.reliable
    assert int(without.sum()) < 0.7 * int(same.contours.reliable.sum()), "what may hide the object"


def test_a_correspondence_needs_one_end_on_the_object(scene: Tumble) -> None:
    masks = torch.full((2, 4, 4), BACKGROUND, dtype=torch.uint8)
    masks[:, :, 2:], masks[0, 1, 1] = UNKNOWN, OBJECT
    uv = torch.tensor([[1.5, 1.5], [3.5, 1.5]])
    kept = on_object(Match(0, 1, uv, uv, torch.ones(2)), masks)
    assert kept.uv_i.tolist() == [[1.5, 1.5]]


def test_a_part_is_cut_where_few_points_are_seen_before_and_after(scene: Tumble, inputs: stage.Inputs) -> None:
    """The film jumps between frames 3 and 4, across which nothing is matched."""
    rng = torch.Generator().manual_seed(0)
    near = [(i, j) for j in range(10) for i in range(j) if j - i <= 3 and not i <= 3 < j]
    matches = [on_object(scene.match(i, j, rng, noise=0), inputs.capture.masks) for i, j in near]
    observed = Observed(QUICK, inputs, gather_keypoints(matches, NO_TRACKS, inputs.capture.camera, N))
    T = scene.T_cam_obj
    part = Partial(tuple(range(10)), T.rotation.matrix()[:10].double(), T.xyz[:10].double())
    assert [piece.frames for piece in cut(observed, part, 3.0, 10)] == [(0, 1, 2, 3), (4, 5, 6, 7, 8, 9)]
    assert [piece.frames for piece in cut(observed, part, 3.0, 0)] == [part.frames]


def test_of_two_segments_of_the_same_frames_the_one_that_matches_confirm_is_kept(
    scene: Tumble, inputs: stage.Inputs
) -> None:
    """A frame that is turned by 60 degrees is left out of its segment; what then adds no frame is not used."""
    rng = torch.Generator().manual_seed(0)
    near = [(i, j) for j in range(10) for i in range(j) if j - i <= 3]
    matches = [on_object(scene.match(i, j, rng), inputs.capture.masks) for i, j in near]
    sure = Observed(QUICK, inputs, gather_keypoints(matches, NO_TRACKS, inputs.capture.camera, N))
    R, t = scene.T_cam_obj.rotation.matrix()[:10].double(), scene.T_cam_obj.xyz[:10].double()
    wrong = R.clone()
    wrong[9] = SO3.exp(torch.tensor([0.6, 0.8, 0.3], dtype=torch.float64)).matrix() @ R[9]
    true, spoilt = Partial(tuple(range(9)), R[:9], t[:9]), Partial(tuple(range(10)), wrong, t)
    assert [part.frames for part in segments._supported(sure, [spoilt])] == [tuple(range(9))]
    noisy = Partial(true.frames, SO3.exp(0.02 * torch.randn(9, 3, generator=rng).double()).matrix() @ true.R, true.t)
    (kept,) = segments._supported(sure, [noisy, true])
    assert torch.equal(kept.R, true.R)


def test_chained_tracks_are_used_where_matches_are_few(scene: Tumble, inputs: stage.Inputs) -> None:
    """Frame 8 has no matches; chained tracks go through all frames."""
    rng, n = torch.Generator().manual_seed(0), 10
    near = [(i, j) for j in range(n) for i in range(j) if j - i <= 3 and 8 not in (i, j)]
    matches = [on_object(scene.match(i, j, rng, noise=0), inputs.capture.masks) for i, j in near]
    chained = inputs.tracks.select(inputs.tracks.frame < n)
    chained = replace(chained, uv=chained.uv + 0.3)  # Else they have some positions in common.
    observed = Observed(QUICK, inputs, gather_keypoints(matches, chained, inputs.capture.camera, N))
    T = scene.T_cam_obj
    part = Partial(tuple(range(n)), T.rotation.matrix()[:n].double(), T.xyz[:n].double())
    tracks = segments.matched_tracks(observed, part)
    is_chained = (tracks.uv[:, None] == chained.uv[None]).all(-1).any(1)
    assert is_chained[tracks.frame == 8].all()
    assert (tracks.frame == 8).any()
    through_it = torch.isin(tracks.point, tracks.point[tracks.frame == 8])
    assert not is_chained[~through_it].any()
    assert (~through_it).any()
    without_it = segments.matched_tracks(observed, part.select([k for k in range(n) if k != 8]))
    assert not (without_it.uv[:, None] == chained.uv[None]).all(-1).any()


def windows(losses: list[tuple[float, float]], turns: list[float]) -> Windows:
    """Windows of four frames, one every two; the rotations of each deviate increasingly by an angle [degrees]."""
    frames = 2 * torch.arange(len(losses))[:, None] + torch.arange(4)
    step = torch.deg2rad(torch.tensor(turns, dtype=torch.float64))[:, None] * torch.arange(4)
    R = SO3.exp(torch.stack([step, 0 * step, 0.1 * frames], -1)).matrix()
    return Windows(frames, torch.stack([R, R.mT], 1), torch.tensor(losses, dtype=torch.float64))


def test_windows_are_used_if_they_are_certain_and_agree_with_a_neighbour() -> None:
    certain, doubtful = (0.1, 0.2), (0.1, 0.11)
    assert segments._runs(windows([certain] * 4, [0.0] * 4)) == [[0, 1, 2, 3]]
    assert segments._runs(windows([certain, certain, doubtful, certain, certain], [0.0] * 5)) == [[0, 1], [3, 4]]
    assert segments._runs(windows([certain] * 4, [0.0, 0.0, 30.0, 30.0])) == [[0, 1], [2, 3]]


def test_poses_of_another_method_are_not_confirmed_by_matches(scene: Tumble, inputs: stage.Inputs) -> None:
    """One frame is turned by 60 degrees; with all frames confirmed, none would be lost."""
    right, wrong = truth(scene), 8
    turned = replace(right, T_cam_obj=SE3(right.T_cam_obj.wxyz.clone(), right.T_cam_obj.xyz))
    turn = SO3.exp(torch.tensor([0.6, 0.8, 0.3]))
    turned.T_cam_obj.wxyz[wrong] = (turn @ right.T_cam_obj.rotation[wrong]).wxyz
    assert not stage.assess(inputs, right).quality.lost[wrong]
    assert stage.assess(inputs, turned).quality.lost[wrong]


@pytest.mark.parametrize("enough", [False, True])
def test_the_network_sees_the_pairs_beside_those_that_have_many_matches(
    enough: bool, inputs: stage.Inputs, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Those beside the pair with the most matches come first; pairs of frames of one part are left out there, too."""
    asked: list[list[tuple[int, int]]] = []
    step, counts = segments.LEARNED_STRIDE, {(3, 15): segments.MIN_PROMISING + 5, (6, 24): segments.MIN_PROMISING}

    def matches(inputs: stage.Inputs, pairs: list[tuple[int, int]], matcher: str) -> list[Match]:
        asked.append(pairs)
        sizes = [(pair, counts.get(pair, segments.MIN_PROMISING - 1)) for pair in pairs]
        return [Match(*pair, *torch.zeros(2, n, 2), torch.ones(n)) for pair, n in sizes]

    monkeypatch.setattr(segments, "_matched", matches)
    monkeypatch.setattr(segments, "on_object", lambda match, _: match)
    if enough:
        monkeypatch.setattr(segments, "MAX_BESIDE", 6)
    near, far = segments._learned(inputs, [{2, 4, 14}])
    of_near, coarse, beside = asked
    assert (len(near), len(far)) == (len(of_near), len(coarse) + len(beside))
    assert set(counts) <= set(coarse)
    assert all(i % step == j % step == 0 for i, j in coarse)
    first = {(i, j) for i in (2, 3, 4) for j in (14, 15, 16)} - {(3, 15), (2, 14), (4, 14)}
    second = {(i, j) for i in (5, 6, 7) for j in (23, 24, 25)} - {(6, 24)}
    assert beside == sorted(first if enough else first | second)
