"""Bundle adjustment against finite differences, and against known poses and points."""

from dataclasses import replace

import pytest
import torch
from torch import Tensor

from tumble.backends import bundle_kernel
from tumble.maths.se3 import SO3
from tumble.poses.sfm import bundle_adjustment
from tumble.poses.sfm.bundle_adjustment import BundleState, Problem
from tumble.poses.sfm.tracks import Tracks
from tumble.scene.camera import Camera

CAMERA = Camera(torch.tensor([240.0, 250.0, 64.0, 60.0]), 128, 128)


def scene(groups: int, frames: int, points: int, seed: int = 0) -> BundleState:
    """Random rotations of random points about (0, 0, 1)."""
    rng = torch.Generator().manual_seed(seed)
    like = {"generator": rng, "dtype": torch.float64}
    steps = 0.2 * torch.randn(groups, 1, 3, **like) + 0.05 * torch.randn(groups, frames, 3, **like)
    R = [torch.eye(3, dtype=torch.float64).repeat(groups, 1, 1)]
    for k in range(1, frames):
        R.append(SO3.exp(steps[:, k]).matrix() @ R[-1])
    t = torch.tensor([0.0, 0.0, 1.0]).double() + 0.02 * torch.randn(groups, frames, 3, **like)
    return BundleState(torch.stack(R, 1), t, 0.12 * torch.randn(groups * points, 3, **like))


def observed(truth: BundleState, noise: float = 0.0, seed: int = 5) -> Problem:
    """A problem in which every frame of a group observes every point of the group."""
    g, f = truth.t.shape[:2]
    n = len(truth.X)
    group = torch.arange(n) // (n // g)
    point = torch.arange(n).repeat_interleave(f)
    frame = group[point] * f + torch.arange(f).repeat(n)
    tracks = Tracks(frame, point, torch.zeros(n * f, 2, dtype=torch.float64))
    problem = Problem(
        CAMERA,
        tracks,
        group,
        torch.ones(n * f, dtype=torch.float64),
        torch.tensor([64.0, 60.0]).double().expand(g, f, 2),
        torch.full((g, f), 20.0).double(),
        0.2,
        0.3,
    )
    uv, _ = bundle_adjustment.residuals(problem, truth)
    rng = torch.Generator().manual_seed(seed)
    uv = uv + noise * torch.randn(uv.shape, generator=rng, dtype=torch.float64)
    return replace(problem, tracks=replace(tracks, uv=uv))


def perturbed(truth: BundleState, angle: float, seed: int = 7) -> BundleState:
    """Poses and points with random errors, of rotation with the standard deviation `angle` [radians]."""
    rng = torch.Generator().manual_seed(seed)
    like = {"generator": rng, "dtype": torch.float64}
    R = SO3.exp(angle * torch.randn(*truth.t.shape, **like)).matrix() @ truth.R
    shift, moved = (0.02 * torch.randn(*x.shape, **like) for x in (truth.t, truth.X))
    return BundleState(R, truth.t + shift, truth.X + moved)


def with_wrong_focal(truth: BundleState, problem: Problem, factor: float) -> tuple[Problem, BundleState]:
    """The same observations under an assumed focal length, the true one times a factor, and an initial state for it."""
    g = len(truth.R)
    shrink = torch.tensor([1 / factor, 1 / factor, 1.0]).double()
    start = BundleState(truth.R, shrink * truth.t, truth.X / factor, torch.zeros(g, dtype=torch.float64))
    return replace(problem, camera=CAMERA.zoomed(factor), radius=problem.radius / factor), start


def relative_errors(found: BundleState, truth: BundleState) -> Tensor:
    """Angles between the estimated and true rotations from the first frame of each group [radians]."""
    a, b = (s.R @ s.R[:, :1].mT for s in (found, truth))
    return SO3.from_matrix(a @ b.mT).angle()


def linearised(problem: Problem, at: BundleState, scale: float) -> bundle_adjustment._System:
    return bundle_adjustment._linearise(problem, at, scale, bundle_adjustment._layout(problem))


def test_the_gradient_equals_finite_differences_of_the_cost() -> None:
    """For cameras and points, with the Cauchy loss and priors."""
    truth = scene(2, 3, 5)
    problem, at = observed(truth, noise=1.0), perturbed(truth, 0.05)
    system = linearised(problem, at, 1.5)
    h = 1e-6

    def cost(d_cam: Tensor, d_point: Tensor) -> Tensor:
        return linearised(problem, bundle_adjustment._apply_step(at, d_cam, d_point), 1.5).cost.sum()

    cameras, points = torch.zeros(6, 6).double(), torch.zeros(10, 3).double()
    for index in range(36):
        d = torch.zeros(36).double().index_fill(0, torch.tensor([index]), h).reshape(6, 6)
        slope = (cost(d, points) - cost(-d, points)) / (2 * h)
        # `g_cam` and `g_point` leave out the factor 2 of the derivative 2 r of r^2.
        assert float(slope) == pytest.approx(2 * float(system.g_cam.flatten()[index]), rel=1e-4, abs=1e-3)
    for index in range(30):
        d = torch.zeros(30).double().index_fill(0, torch.tensor([index]), h).reshape(10, 3)
        slope = (cost(cameras, d) - cost(cameras, -d)) / (2 * h)
        assert float(slope) == pytest.approx(2 * float(system.g_point.flatten()[index]), rel=1e-4, abs=1e-3)


def test_derivatives_by_the_focal_length_equal_finite_differences() -> None:
    """For two groups with a focal length each, with priors.

    The mixed second derivatives by cameras and points are compared with differences of the gradient, without a robust
    loss, where residuals vanish; those of the points' prior nearly do, as its radius is huge.
    """
    truth = scene(2, 3, 5)
    problem, at = with_wrong_focal(truth, observed(truth, noise=1.0), 1.1)
    h = 1e-6

    def at_focal(
        d: Tensor, problem: Problem = problem, at: BundleState = at, scale: float = 1.5
    ) -> bundle_adjustment._System:
        return linearised(problem, replace(at, log_focal=d), scale)

    system = at_focal(torch.full((2,), 0.02).double(), replace(problem, log_focal_prior=-0.1))
    for group in range(2):
        d = torch.zeros(2).double().index_fill(0, torch.tensor([group]), h)
        a, b = (at_focal(0.02 + s * d, replace(problem, log_focal_prior=-0.1)).cost.sum() for s in (1, -1))
        assert system.border is not None
        assert float((a - b) / (2 * h)) == pytest.approx(2 * float(system.border.g[group]), rel=1e-5)
    centres = CAMERA.project(truth.t).double()
    exact, where = (
        replace(observed(truth), centre=centres, radius=1e3),
        replace(truth, log_focal=torch.zeros(2).double()),
    )
    border = at_focal(torch.zeros(2).double(), exact, where, 1e9).border
    a, b = (at_focal(torch.full((2,), s * h).double(), exact, where, 1e9) for s in (1, -1))
    assert border is not None
    torch.testing.assert_close((a.g_point - b.g_point) / (2 * h), border.point, rtol=1e-5, atol=1e-2)
    torch.testing.assert_close((a.g_cam - b.g_cam) / (2 * h), border.cam, rtol=1e-5, atol=1e-2)


@pytest.mark.parametrize("factor", [None, 1.1])
@pytest.mark.parametrize("short", [0, 3])
def test_elimination_solves_the_dense_system(short: int, factor: float | None, monkeypatch: pytest.MonkeyPatch) -> None:
    """For one group, the step equals that of the dense normal equations.

    Both ways to eliminate points are tested, each with a known and with an estimated focal length.
    """
    monkeypatch.setattr(bundle_adjustment, "SHORT_TRACK", short)
    monkeypatch.setattr(bundle_adjustment, "PAIRS_AT_ONCE", 4)
    truth = scene(1, 3, 6)
    problem, at = observed(truth, noise=0.5), perturbed(truth, 0.02)
    if factor is not None:
        problem, at = with_wrong_focal(at, problem, factor)
    system = linearised(problem, at, 2.0)
    damping = torch.tensor([0.01]).double()
    d_cam, d_point, d_focal = bundle_adjustment._solve(problem, at, system, damping, bundle_adjustment._layout(problem))
    H = torch.zeros(36, 36).double()
    for c in range(3):
        H[6 * c : 6 * c + 6, 6 * c : 6 * c + 6] = system.U[c]
    for p in range(6):
        H[18 + 3 * p : 21 + 3 * p, 18 + 3 * p : 21 + 3 * p] = system.V[p]
    for o, (c, p) in enumerate(zip(problem.tracks.frame.tolist(), problem.tracks.point.tolist(), strict=True)):
        H[6 * c : 6 * c + 6, 18 + 3 * p : 21 + 3 * p] += system.W[o]
        H[18 + 3 * p : 21 + 3 * p, 6 * c : 6 * c + 6] += system.W[o].T
    g = torch.cat([system.g_cam.flatten(), system.g_point.flatten()])
    found = torch.cat([d_cam.flatten(), d_point.flatten()])
    if system.border is not None:
        assert d_focal is not None
        side = torch.cat([system.border.cam.flatten(), system.border.point.flatten()])[:, None]
        H = torch.cat([torch.cat([H, side], 1), torch.cat([side.T, system.border.H[:, None]], 1)])
        g, found = torch.cat([g, system.border.g]), torch.cat([found, d_focal])
    assert (system.border is None) == (d_focal is None) == (factor is None)
    H = H + torch.diag(0.01 * H.diagonal() + 1e-9)
    torch.testing.assert_close(found, torch.linalg.solve(H, -g), rtol=1e-6, atol=1e-9)


@pytest.mark.parametrize("factor", [None, 1.1])
def test_the_kernel_makes_the_step_of_plain_torch(factor: float | None) -> None:
    """Cost and step of two groups whose points are observed in 1 to 7 frames, in any order, by outliers too."""
    truth = scene(2, 7, 40)
    problem, at = observed(truth, noise=0.5), perturbed(truth, 0.05)
    if factor is not None:
        problem, at = with_wrong_focal(at, problem, factor)
    rng = torch.Generator().manual_seed(2)
    kept = torch.rand(len(problem.tracks), generator=rng) < 0.6
    kept |= problem.tracks.frame % 7 == problem.tracks.point % 7
    shuffled = torch.nonzero(kept)[:, 0][torch.randperm(int(kept.sum()), generator=rng)]
    tracks = Tracks(*(x[shuffled] for x in vars(problem.tracks).values()))
    uv = tracks.uv + 40 * (torch.rand(len(tracks), 1, generator=rng) < 0.1)
    weight = 0.5 + torch.rand(len(tracks), generator=rng).double()
    # Groups are interleaved: the kernel sorts points by group.
    problem = replace(problem, tracks=replace(tracks, uv=uv), weight=weight, log_focal_prior=0.02)
    order = torch.randperm(len(at.X), generator=rng)
    place = torch.argsort(order)
    problem = replace(problem, group=problem.group[order], tracks=replace(problem.tracks, point=place[tracks.point]))
    at = replace(at, X=at.X[order])
    kernel = bundle_kernel()
    assert kernel is not None, "the CPU has one"
    damping = torch.tensor([0.01, 0.3]).double()
    cost, step = bundle_adjustment._equations(problem, 1.5)
    kernel_cost, kernel_step = bundle_adjustment._kernel_equations(kernel, problem, 1.5)
    torch.testing.assert_close(kernel_cost(at).cost, cost(at).cost, rtol=1e-12, atol=0)
    moved, moved_by_kernel = step(at, cost(at).system, damping), kernel_step(at, None, damping)
    for name, x in vars(moved).items():
        # The condition of the normal equations is about 1e6.
        torch.testing.assert_close(getattr(moved_by_kernel, name), x, rtol=1e-9, atol=1e-9)


def test_exact_observations_give_exact_poses() -> None:
    """Initial errors of ten degrees per frame vanish; the priors leave a bias below a hundredth of a degree."""
    truth = scene(3, 6, 30)
    found, cost = bundle_adjustment.adjust(observed(truth), perturbed(truth, 0.1), steps=60, scale=3.0, tolerance=0.0)
    assert relative_errors(found, truth).max() < 2e-3
    assert bundle_adjustment.residuals(observed(truth), found)[0].abs().max() < 0.1
    # The remaining cost is that of the priors at the truth, NOISE^2 per squared standard deviation.
    assert (cost < 3).all()


@pytest.mark.parametrize("factor", [0.8, 1.25])
def test_an_assumed_focal_length_is_corrected(factor: float) -> None:
    """For two groups with 0.2 pixels of noise.

    The inverse of the normal equations at the truth gives the focal length a standard deviation below a hundredth, and
    the prior's bias is smaller.
    """
    truth = scene(2, 12, 60)
    problem, start = with_wrong_focal(truth, observed(truth, noise=0.2), factor)
    for scale in (3.0, 1.0, 1.0):
        start, _ = bundle_adjustment.adjust(problem, start, steps=30, scale=scale, tolerance=0.0)
    assert start.log_focal is not None
    torch.testing.assert_close(start.log_focal.exp() * factor, torch.ones(2).double(), atol=0.03, rtol=0)
    assert relative_errors(start, truth).rad2deg().max() < 0.5


def test_a_known_focal_length_stays_as_it_is() -> None:
    """Even a wrong one, although an estimated focal length would lower the cost."""
    truth = scene(1, 8, 30)
    problem, start = with_wrong_focal(truth, observed(truth), 0.8)
    kept, cost = bundle_adjustment.adjust(problem, replace(start, log_focal=None), steps=30, scale=3.0)
    found, lower_cost = bundle_adjustment.adjust(problem, start, steps=30, scale=3.0)
    assert kept.log_focal is None
    assert found.log_focal is not None
    assert lower_cost < cost


def test_outliers_have_little_influence() -> None:
    truth = scene(1, 8, 60)
    problem = observed(truth, noise=0.2)
    rng = torch.Generator().manual_seed(0)
    outlier = torch.rand(len(problem.tracks), generator=rng) < 0.15
    uv = problem.tracks.uv + outlier[:, None] * 15 * torch.randn(len(outlier), 2, generator=rng, dtype=torch.float64)
    problem = replace(problem, tracks=replace(problem.tracks, uv=uv))
    rough, _ = bundle_adjustment.adjust(problem, perturbed(truth, 0.05), steps=30, scale=3.0)
    found, _ = bundle_adjustment.adjust(problem, rough, steps=30, scale=0.5)
    # 0.2 pixels over 50 inliers spread over 30 pixels: a tenth of a degree, more along the viewing rays.
    assert relative_errors(found, truth).rad2deg().max() < 1.0


def test_groups_are_independent() -> None:
    """Two groups adjusted side by side get the same poses as each on its own."""
    truth = scene(2, 4, 12)
    problem, start = observed(truth, noise=0.3), perturbed(truth, 0.05)
    both, _ = bundle_adjustment.adjust(problem, start, steps=15, scale=1.0, tolerance=0.0)
    for g in range(2):
        mine = problem.group == g
        tracks = problem.tracks.select(mine[problem.tracks.point])
        alone = Problem(
            CAMERA,
            replace(tracks, frame=tracks.frame - 4 * g),
            torch.zeros(12, dtype=torch.long),
            torch.ones(len(tracks)).double(),
            problem.centre[g : g + 1],
            problem.centre_sigma[g : g + 1],
            problem.depth_sigma,
            problem.radius,
        )
        single, _ = bundle_adjustment.adjust(
            alone,
            BundleState(start.R[g : g + 1], start.t[g : g + 1], start.X[mine]),
            steps=15,
            scale=1.0,
            tolerance=0.0,
        )
        torch.testing.assert_close(single.R[0], both.R[g], atol=1e-6, rtol=0)


def test_points_are_triangulated_where_their_rays_meet() -> None:
    """For six views over a wide rotation; the prior position shifts points by a thousandth of the sphere's radius."""
    truth = scene(1, 6, 20)
    problem = observed(truth)
    X = bundle_adjustment.triangulate(problem.tracks, truth.R[0], truth.t[0], CAMERA, torch.full((6,), 0.2).double())
    assert (X - truth.X).norm(dim=-1).median() < 0.01
