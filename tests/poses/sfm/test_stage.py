"""Stage 1 by structure from motion, on a tumbling ellipsoid with noisy and partly wrong matches."""

import math
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from torch import Tensor

from tests.lopsided import DISTANCE, Tumble, moving, truth, tumbling
from tumble.engine import State
from tumble.engine.loop import Progress, Stage, drive
from tumble.evaluation import metrics
from tumble.maths import SE3, SO3
from tumble.poses.result import PoseResult
from tumble.poses.sfm import schedule, stage
from tumble.poses.sfm.adjustment import adjust_windows, averaged_windows, deviation, grow_windows
from tumble.poses.sfm.observations import focal_length, with_focal_length
from tumble.scene.capture import Capture
from tumble.scene.match import Match

pytestmark = pytest.mark.usefixtures("no_turntable")
QUICK = stage.Config(
    window_sizes=(6,),
    window_scales=(3.0, 1.0, 0.5),
    global_scales=(3.0, 2.0, 1.0, 0.7, 0.5),
    growing=(),
    fallbacks=(),
    relocalizations=0,
    perturbations=0,
    early_perturbations=0,
    max_corrections=0,
    texture_rounds=1,
)


def matches(scene: Tumble, wrong: float = 0.15) -> tuple[Match, ...]:
    rng = torch.Generator().manual_seed(0)
    n = len(scene.capture)
    return tuple(scene.match(t - k, t, rng, wrong=wrong) for k in (1, 2, 4) for t in range(k, n))


@pytest.fixture(scope="module")
def scene() -> Tumble:
    return tumbling(20, points=200)


@pytest.fixture(scope="module")
def tracked(scene: Tumble) -> PoseResult:
    return drive(stage, QUICK, stage.gather(scene.capture, matches(scene)), seed=0)


def test_it_is_a_stage() -> None:
    assert isinstance(stage, Stage)


def test_rotations_are_found(scene: Tumble, tracked: PoseResult) -> None:
    """170 degrees of tumbling, 0.2 pixels of noise, every seventh match wrong."""
    scores = metrics.rotation_scores(tracked.trajectory, truth(scene))
    assert scores["rotation_median_degrees"] < 1.5
    assert scores["rotation_below_5_percent"] == 100


def test_distances_are_found(scene: Tumble, tracked: PoseResult) -> None:
    aligned = metrics.align(tracked.trajectory, truth(scene)).to_truth(tracked.trajectory)
    reach = float(truth(scene).camera_positions.norm(dim=-1).mean())
    assert metrics.position_scores(aligned, truth(scene), tolerance=0.1 * reach)["auc_percent"] > 80


def test_the_quality_of_good_poses_is_good(scene: Tumble, tracked: PoseResult) -> None:
    assert not tracked.quality.lost.any()
    assert tracked.quality.overlap.min() > 0.85
    assert tracked.quality.residual.max() < 1
    assert not tracked.quality.observability.axis_unobservable


def test_an_assumed_focal_length_is_estimated_and_a_known_one_kept(scene: Tumble, tracked: PoseResult) -> None:
    """The focal length is a fifth too short. In 20 frames and few rounds, with a prior on the assumed value, two thirds
    of that error are corrected, which suffices for the rotations.
    """
    short = replace(scene.capture, camera=scene.capture.camera.zoomed(0.8))
    assumed = drive(stage, QUICK, stage.gather(replace(short, focal_assumed=True), matches(scene)), seed=0)
    known = drive(stage, QUICK, stage.gather(short, matches(scene)), seed=0)
    focal = float(scene.capture.camera.fx_fy_cx_cy[0])
    assert float(assumed.camera.fx_fy_cx_cy[0]) == pytest.approx(focal, rel=0.07)
    assert torch.equal(assumed.camera.fx_fy_cx_cy[2:], scene.capture.camera.fx_fy_cx_cy[2:])
    assert torch.equal(known.camera.fx_fy_cx_cy, short.camera.fx_fy_cx_cy)
    assert torch.equal(tracked.camera.fx_fy_cx_cy, scene.capture.camera.fx_fy_cx_cy)
    medians = [metrics.rotation_scores(x.trajectory, truth(scene))["rotation_median_degrees"] for x in (assumed, known)]
    assert medians[0] < 1.5 < medians[1]


def test_an_assumed_focal_length_returns_where_nothing_tells_another() -> None:
    """An object that does not rotate, after a round that has made the focal length longer by a third."""
    T = tumbling(8).T_cam_obj
    still = SE3(T.wxyz[:1].expand(8, 4), T.xyz[:1].expand(8, 3))
    scene, rng = moving(still, points=60), torch.Generator().manual_seed(0)
    exact = tuple(scene.match(t - 1, t, rng, noise=0.0, wrong=0.0) for t in range(1, 8))
    inputs = stage.gather(replace(scene.capture, focal_assumed=True), exact)
    longer = torch.tensor(0.3, dtype=torch.float64)
    poses = stage.Poses(still.rotation.matrix(), still.xyz / DISTANCE, longer)
    state = State(0, poses, None, torch.Generator().manual_seed(0))
    cfg = replace(QUICK, iterations=40)
    for _ in range(3):
        current = with_focal_length(inputs, state.params.log_focal)
        state.params, _ = stage.adjust_all(cfg, current, state, 1.0)
    assert abs(float(state.params.log_focal)) < 0.5 * longer


def test_another_focal_length_changes_the_size_of_the_object_only(scene: Tumble) -> None:
    """Its silhouettes keep their size in pixels, at the same distance."""
    inputs = stage.gather(scene.capture, matches(scene))
    longer = with_focal_length(inputs, torch.tensor(2.0, dtype=torch.float64).log())
    assert focal_length(longer.capture) == pytest.approx(2 * focal_length(inputs.capture))
    assert longer.radius == pytest.approx(inputs.radius / 2)
    torch.testing.assert_close(longer.silhouettes.radius, inputs.silhouettes.radius / 2)
    torch.testing.assert_close(longer.silhouettes.centre, inputs.silhouettes.centre)


def test_a_frame_without_the_object_is_lost_and_the_others_are_not_affected(scene: Tumble) -> None:
    masks = scene.capture.masks.clone()
    masks[9] = 0
    capture = replace(scene.capture, masks=masks)
    some = tuple(m for m in matches(scene) if 9 not in (m.i, m.j))
    out = drive(stage, QUICK, stage.gather(capture, some), seed=0)
    assert torch.nonzero(out.quality.lost)[:, 0].tolist() == [9]
    others = [k for k in range(20) if k != 9]
    scores = metrics.rotation_scores(out.trajectory.select(others), truth(scene).select(others))
    assert scores["rotation_median_degrees"] < 2


def test_a_capture_that_has_not_converged_is_attempted_again_and_the_best_result_is_kept(scene: Tumble) -> None:
    """The second attempt starts from more rotations."""
    inputs = stage.gather(scene.capture, matches(scene))
    state = stage.init(QUICK, inputs, torch.Generator().manual_seed(0))
    cfg = replace(QUICK, growing=(4,), converged_loss=0.0)
    kept = []
    for state.step, now in enumerate(stage.schedule(cfg)):
        found = stage.step(cfg, inputs, state)
        if isinstance(now.phase, stage.KeepBest) and not (now.attempt and now.mends):
            kept.append((now.attempt, float(state.memory["loss"]), state.params.R))
        assert found or now.attempt == 0 or now.mends
    # The first attempt is rated before and after it is mended.
    assert [start for start, _, _ in kept] == [0, 0, 1]
    assert kept[2][1] <= kept[0][1]
    assert torch.equal(kept[2][2], kept[0][2]) == (kept[2][1] == kept[0][1])
    # Once converged, further attempts are skipped.
    cfg = replace(cfg, converged_loss=float("inf"))
    state.step = stage.schedule(cfg).index(stage.Step(stage.AverageRotations(), 1))
    assert stage.step(cfg, inputs, state) == {}


def test_a_motion_that_matches_hardly_show_is_found_by_windows_that_grow() -> None:
    """Six matches of ten are wrong: from windows of a few frames alone the motion is found only roughly."""
    scene = tumbling(28, points=100)
    inputs = stage.gather(scene.capture, matches(scene, wrong=0.6))
    true_R, cfg = truth(scene).T_cam_obj.rotation.matrix().double(), stage.Config()
    still, rng = torch.eye(3, dtype=torch.float64).repeat(28, 1, 1), torch.Generator().manual_seed(0)
    R = still
    for size in cfg.window_sizes:
        windows = adjust_windows(cfg, inputs, R, rng, size=size)
        R = averaged_windows(windows.frames, windows.consistent, n_frames=28)
    assert deviation(R, true_R).median() > math.radians(8)
    grown = grow_windows(cfg, inputs, still, rng, size=6, directions=cfg.directions)
    assert grown.frames.tolist() == [list(range(28))]
    assert deviation(grown.best[0], true_R).median() < math.radians(3)


def test_an_attempt_is_mended_before_it_is_compared_unless_it_has_converged(scene: Tumble) -> None:
    """A frame turned by 20 degrees costs more than the others and is relocalized; a good capture is left alone."""
    cfg = replace(QUICK, growing=(), relocalizations=1, relocalized_scales=(0.5,), converged_loss=0.0)
    steps = stage.schedule(cfg)
    mending = [k for k, now in enumerate(steps) if now.mends]
    assert [type(steps[k].phase) for k in mending] == [stage.Relocalize, stage.AdjustAll, stage.KeepBest]
    inputs = stage.gather(scene.capture, matches(scene))
    state = stage.init(cfg, inputs, torch.Generator().manual_seed(0))
    for state.step in range(mending[0] - 1):
        stage.step(cfg, inputs, state)
    R = state.params.R.clone()
    R[10] = SO3.exp(torch.tensor([0.35, 0.0, 0.0], dtype=torch.float64)).matrix() @ R[10]
    state.params = replace(state.params, R=R)
    converged = replace(cfg, converged_loss=float("inf"))
    for state.step in range(mending[0] - 1, mending[-1] + 1):
        assert state.step not in mending or stage.step(converged, inputs, state) == {}
        stage.step(cfg, inputs, state)
    true_R = truth(scene).T_cam_obj.rotation.matrix().double()
    assert float(deviation(state.params.R, true_R)[10]) < math.radians(3)


def turned(scene: Tumble, frame: int, degrees: float) -> stage.Poses:
    """The true poses but for one frame, which is turned about the camera's y axis."""
    T = scene.T_cam_obj
    R = T.rotation.matrix().clone()
    R[frame] = SO3.exp(torch.tensor([0.0, math.radians(degrees), 0.0], dtype=torch.float64)).matrix() @ R[frame]
    return stage.Poses(R, T.xyz.double() / T.xyz[:, 2].double().mean(), torch.zeros((), dtype=torch.float64))


def test_corrections_are_repeated_until_no_rotation_changes_by_a_degree(scene: Tumble) -> None:
    """One frame that still moves is enough for another round; after a round without, all further steps do nothing."""
    cfg = replace(QUICK, max_corrections=4)
    steps = [step.phase for step in stage.schedule(cfg)]
    checks = [k for k, phase in enumerate(steps) if isinstance(phase, stage.CheckSettled)]
    inputs = stage.gather(scene.capture, matches(scene))
    state = stage.init(cfg, inputs, torch.Generator().manual_seed(0))
    rounds = ((35.0, False), (5.0, False), (3.5, False), (2.8, True), (2.8, True))
    for state.step, (degrees, settled) in zip(checks, rounds, strict=True):
        state.params = turned(scene, 3, degrees)
        stage.step(cfg, inputs, state)
        assert bool(state.memory["settled"]) == settled
    state.step = checks[-2] + 2
    assert steps[state.step] == stage.TrackTexture()
    assert stage.step(cfg, inputs, state) == {}


def test_corrections_that_raise_the_loss_are_undone(scene: Tumble) -> None:
    cfg = replace(QUICK, max_corrections=2)
    checks = [k for k, step in enumerate(stage.schedule(cfg)) if isinstance(step.phase, stage.CheckSettled)]
    inputs = stage.gather(scene.capture, matches(scene))
    state = stage.init(cfg, inputs, torch.Generator().manual_seed(0))
    for state.step, degrees in zip(checks[:2], (5.0, 20.0), strict=True):
        state.params = turned(scene, 3, degrees)
        scalars = stage.step(cfg, inputs, state)
    assert scalars["undone"] == 1
    assert torch.equal(state.params.R, turned(scene, 3, 5.0).R)
    assert bool(state.memory["settled"])


def test_two_attempts_that_agree_are_enough(scene: Tumble) -> None:
    """A third attempt is skipped after two that found the same, and is not after two that differ by ten degrees."""
    cfg = replace(QUICK, converged_loss=0.0, growing=(6, 6))
    steps = stage.schedule(cfg)
    keep = [k for k, step in enumerate(steps) if isinstance(step.phase, stage.KeepBest)]
    inputs = stage.gather(scene.capture, matches(scene))
    for degrees, agreed in ((0.5, True), (10.0, False)):
        state = stage.init(cfg, inputs, torch.Generator().manual_seed(0))
        state.params = turned(scene, 3, 0.0)
        state.step = keep[0]
        stage.step(cfg, inputs, state)
        half = torch.arange(20) < 10
        state.params = replace(
            state.params, R=torch.where(half[:, None, None], state.params.R, rotated(state, degrees))
        )
        state.step = steps.index(stage.Step(stage.KeepBest(0.5), 1))
        stage.step(cfg, inputs, state)
        assert bool(state.memory["agreed"]) == agreed
        state.step = steps.index(stage.Step(stage.AverageRotations(), 2))
        assert (stage.step(cfg, inputs, state) == {}) == agreed


def rotated(state: State, degrees: float) -> Tensor:
    """The rotations of a state, all turned about the object's x axis."""
    return state.params.R @ SO3.exp(torch.tensor([math.radians(degrees), 0.0, 0.0], dtype=torch.float64)).matrix()


@pytest.mark.parametrize("degrees", [(0.0, 20.0), (20.0, 0.0)])
def test_attempts_of_both_kinds_compete_apart_and_the_better_result_is_taken(
    scene: Tumble, degrees: tuple[float, float]
) -> None:
    """The best poses of each kind differ from the truth in one frame, by these angles."""
    cfg = replace(QUICK, converged_loss=0.0, growing=(6,), fallbacks=(schedule.Fallback((6,), 1.0),))
    steps, kinds = stage.schedule(cfg), (stage.KeepBest, stage.SetAside, stage.KeepBest, stage.TakeBetter)
    inputs = stage.gather(scene.capture, matches(scene))
    state = stage.init(cfg, inputs, torch.Generator().manual_seed(0))
    found = iter(degrees)
    for kind in kinds:
        if kind is stage.KeepBest:
            state.params = turned(scene, 3, next(found))
        ahead = range(state.step + 1, len(steps))
        state.step = next(
            k for k in ahead if isinstance(steps[k].phase, kind) and (steps[k].attempt or kind is stage.TakeBetter)
        )
        stage.step(cfg, inputs, state)
        if kind is stage.SetAside:
            assert state.memory["loss"].isinf()
    assert torch.equal(state.params.R, turned(scene, 3, 0.0).R)


def test_a_part_of_the_motion_that_is_joined_wrongly_is_found_by_perturbation(scene: Tumble) -> None:
    """All frames from the eleventh on are turned by 50 degrees, from which bundle adjustment alone does not return."""
    inputs = stage.gather(scene.capture, matches(scene))
    cfg = replace(QUICK, converged_loss=0.0, perturbations=5, growing=(6,))
    state = stage.init(cfg, inputs, torch.Generator().manual_seed(1))
    good = turned(scene, 3, 0.0)
    behind = torch.arange(20)[:, None, None] >= 10
    state.params = replace(good, R=torch.where(behind, rotated(replace(state, params=good), 50.0), good.R))
    for each in cfg.perturbation_scales:
        state.params, _ = stage.adjust_all(cfg, inputs, state, each)
    assert deviation(state.params.R, good.R).median() > math.radians(10)
    steps = [k for k, step in enumerate(stage.schedule(cfg)) if isinstance(step.phase, stage.Perturb)]
    assert len(steps) == 5
    losses = []
    for state.step in steps:
        losses.append(float(stage.step(cfg, inputs, state)["loss"]))
    assert losses == sorted(losses, reverse=True)
    assert deviation(state.params.R, good.R).median() < math.radians(3)


def test_no_object_is_an_error(scene: Tumble) -> None:
    blank = replace(scene.capture, masks=torch.zeros_like(scene.capture.masks))
    with pytest.raises(ValueError, match="no mask has an object pixel"):
        stage.gather(blank, ())


def test_a_resumed_run_equals_an_uninterrupted_one(scene: Tumble, tmp_path: Path) -> None:
    """Six frames are enough to check that all state is in `State`."""
    few: Capture = replace(
        scene.capture,
        images=scene.capture.images[:6],
        masks=scene.capture.masks[:6],
        names=scene.capture.names[:6],
    )
    inputs = stage.gather(few, tuple(m for m in matches(scene) if m.j < 6))
    short = replace(QUICK, global_scales=(3.0, 1.0), relocalizations=1, max_corrections=2, relocalized_scales=(1.0,))
    whole = drive(stage, short, inputs, seed=3)

    def stop(progress: Progress) -> None:
        if progress.step == 1:
            raise RuntimeError("stopped")

    with pytest.raises(RuntimeError, match="stopped"):
        drive(stage, short, inputs, seed=3, checkpoint=tmp_path / "state.safetensors", every=1, report=stop)
    resumed = drive(stage, short, inputs, seed=3, checkpoint=tmp_path / "state.safetensors", every=1)
    assert torch.equal(resumed.trajectory.T_cam_obj.wxyz, whole.trajectory.T_cam_obj.wxyz)
    assert torch.equal(resumed.points, whole.points)
