"""Renderers, tensors in and tensors out: this page is the contract, a file in this folder is one that keeps it.

Three kernels carry the method: **rasterize** (what the camera sees of the Gaussians), **trace** (what a ray
meets on its way) and **shade** (reflected light). `reference.py` defines *correct*; the others are the same
thing, faster. There are no options: culling, depth and corner interpolation are what the method *is*. Another
rule is another file.

Vocabulary
    *Gaussian*: mean `mu`, rotation `R_q` of its quaternion, standard deviations `s`, opacity `o`. Its third
    axis `n = R_q[:, 2]` is its outward normal. `W = diag(1/s) R_q^T` whitens: the Gaussian at x is `o
    exp(-|W(x - mu)|^2/2)`.
    *Peak*: the point of a ray where that is largest. For a ray `x = a + z d`: `z = W(mu - a).Wd / |Wd|^2`.
    Rasterizer and tracer both take response, depth and corner coordinates at the peak. It is exact in
    perspective (no affine approximation), is the ray-plane hit for a thin Gaussian, and is never further from
    the centre than the response says, edge-on too.
    No screen-space blur: a sphere of 8000 Gaussians at 128 pixels has a silhouette 0.6 pixels too wide without, 1.4
    with the usual 0.3 px^2, and the tracer has none. Gaussians much smaller than a pixel may fall between pixels.
    *alpha*: `min(ALPHA_MAX, o exp(-|W(peak - mu)|^2/2))`, and 0 where that is below `ALPHA_MIN`.

Frames: OpenCV camera with pixel centres at +0.5, object radius 1, linear radiance, quaternions wxyz.
"""

import importlib
import pkgutil
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from functools import cache
from typing import Any, NamedTuple, Protocol, cast, runtime_checkable

import torch
from jaxtyping import Float, Int32
from torch import Tensor

__all__ = [
    "ALPHA_MAX",
    "ALPHA_MIN",
    "Backend",
    "CORNER",
    "FACING",
    "Hits",
    "NEAR",
    "NEAR_SIGMAS",
    "ROUGHNESS_MIN",
    "Rendering",
    "TRACE_SIGMAS",
    "TRACE_T_MIN",
    "T_MIN",
    "VISIBLE",
    "choose",
    "load",
    "names",
    "threads",
    "threads_for_kernels",
    "usable_device",
    "vector_bits",
]

ALPHA_MAX = 0.99
"""Largest alpha of one Gaussian; the gradient is zero beyond, as the function says."""
ALPHA_MIN = 1 / 255
"""A Gaussian does not touch a pixel or ray where its alpha is below this."""
T_MIN = 1e-4
"""A pixel is finished once its transmittance is below this: Gaussians behind contribute nothing."""
FACING = -0.01
"""A Gaussian is seen only if (p/|p|).n <= FACING, p its centre from the camera: back faces are culled."""
NEAR = 0.05
"""Nearest z-depth of a centre that is drawn [object radius]."""
NEAR_SIGMAS = 4.0
"""A Gaussian reaching to within this many standard deviations of the camera's plane is not drawn."""
CORNER = 2.0
"""Corners of a Gaussian's plane lie at +-CORNER standard deviations; 91 % of its weight falls between."""
TRACE_SIGMAS = 3.0
"""The tracer cuts a Gaussian where its peak is further than this from the centre."""
TRACE_T_MIN = 0.03
"""A ray with less transmittance than this is blocked: transmittance 0, radiance divided by its opacity."""
VISIBLE = 0.5
"""A direction is visible from a point where transmittance is at least this."""
ROUGHNESS_MIN = 0.05
"""Roughness below this shades as this: the lobe would be narrower than any set of directions."""


_threads: ContextVar[int | None] = ContextVar("threads", default=None)


def threads() -> int:
    """How many a kernel on the processor may take: torch's number, or what that was before `threads_for_kernels`."""
    return _threads.get() or torch.get_num_threads()


@contextmanager
def threads_for_kernels() -> Iterator[None]:
    """Leave all threads to the kernels: torch's own operations take one.

    Those of a training step are so small that a second thread costs more than it gives: when this came in, stages 2
    and 3 of a capture of 128 pixels took 164 s with two threads for both, 120 s with one for both, and 104 s so.
    """
    before = torch.get_num_threads()
    token = _threads.set(threads())
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(before)
        _threads.reset(token)


def usable_device(name: str) -> torch.device:
    """The device of a name, if this machine has it.

    Raises:
        ValueError: Torch sees none.
    """
    if name == "cuda" and not torch.cuda.is_available():
        raise ValueError("--device cuda: torch sees no NVIDIA GPU here; tumble doctor says what it sees")
    return torch.device(name)


def vector_bits() -> int:
    """Width of the vectors that the CPU's kernels compute with, on this machine."""
    from tumble.backends import _native

    return 32 * _native.library().lanes()


class Rendering(NamedTuple):
    """One view. With w_i = alpha_i prod_{j in front} (1 - alpha_j), "mean" is sum w_i x_i / sum w_i, 0 where
    nothing is."""

    rgb: Float[Tensor, "h w 3"]
    """Linear radiance over black: sum w_i c_i, not divided by alpha."""
    alpha: Float[Tensor, "h w"]
    """Coverage: sum w_i. It is 0, or at least ALPHA_MIN."""
    depth: Float[Tensor, "h w"]
    """Mean z-depth of the peaks, camera frame [object radius]."""
    depth_var: Float[Tensor, "h w"]
    """Variance of the same [object radius^2], summed about t_cam_obj.z so that it survives 32 bits."""
    normal: Float[Tensor, "h w 3"]
    """Mean outward normal, object frame; shorter than 1 where Gaussians disagree."""
    features: Float[Tensor, "h w c"]
    """Mean of the features, each interpolated between its Gaussian's four corners at the peak."""
    weight: Float[Tensor, " n"]
    """Sum of w_i over all pixels. Not differentiable."""
    touched: Int32[Tensor, " n"]
    """Number of pixels under the mask that the Gaussian contributes to."""
    dominant: Int32[Tensor, "h w"]
    """The Gaussian of largest w_i in each pixel, -1 where there is none."""


class Hits(NamedTuple):
    """What rays meet."""

    transmittance: Float[Tensor, " r"]
    """prod (1 - alpha_i); 0 for a blocked ray."""
    radiance: Float[Tensor, "r 3"]
    """sum w_i radiance_i, front to back by peak, over black; zeros when no radiance was given."""
    hit: Int32[Tensor, " r"]
    """The Gaussian of largest w_i, -1 if the ray meets none."""


@runtime_checkable
class Backend(Protocol):
    """A module of this folder. All float tensors of a call share one device and dtype; sizes may be zero."""

    def ready(self, device: torch.device, dtype: torch.dtype) -> str:
        """Empty if this backend can take tensors of that kind here and now, else the reason and the fix."""
        ...

    def rasterize(
        self,
        means: Float[Tensor, "n 3"],
        quats: Float[Tensor, "n 4"],
        scales: Float[Tensor, "n 3"],
        opacity: Float[Tensor, " n"],
        sh: Float[Tensor, "n k 3"],
        corners: Float[Tensor, "n 4 c"],
        R_cam_obj: Float[Tensor, "3 3"],
        t_cam_obj: Float[Tensor, "3"],
        fx_fy_cx_cy: Float[Tensor, "4"],
        height: int,
        width: int,
        mask: Float[Tensor, "#h #w"],
    ) -> Rendering:
        """One view of the Gaussians; differentiable in every float input but the mask.

        The Gaussians of a view are sorted by the z-depth of their centres, ties by index, and drawn front to
        back. Left out are those with z < NEAR, z < NEAR_SIGMAS * (standard deviation along z), or a normal
        that does not face the camera (FACING). The adjoint of `R_cam_obj` is of its nine numbers, taken as
        free (`W = diag(1/s) R_q^T R_cam_obj^T`, view direction `R_cam_obj^T p`); the caller's chart of
        rotations projects it.

        Args:
            means: Centres, object frame [object radius].
            quats: Local to object rotations, wxyz, of any length but 0.
            scales: Standard deviations along the local axes, > 0; the third is the thickness.
            opacity: In [0, 1].
            sh: Radiance c = max(0, sum_k Y_k(v) sh_k), v the object-frame direction from the camera to the
                centre, k in {1, 4, 9, 16}; Y in the order and signs of 3D Gaussian splatting (Y_1.. = -y, z,
                -x times .4886). Linear in its range, so that k = 1 hands over radiance computed elsewhere: sh
                = c / 0.28209479. A negative sum gives black and no gradient; start from positive colours.
            corners: Features at (-,-), (+,-), (-,+), (+,+) CORNER standard deviations along the first two
                axes, bilinear between, constant beyond; c may be 0.
            R_cam_obj: Rotation of the object to the camera.
            t_cam_obj: Translation of the object to the camera [object radius].
            fx_fy_cx_cy: Focal lengths and principal point [pixels].
            height: Rows of the image.
            width: Columns of the image.
            mask: Pixels counted in `touched` where > 0.5; `[1 1]` counts all or none.
        """
        ...

    def build(
        self,
        means: Float[Tensor, "n 3"],
        quats: Float[Tensor, "n 4"],
        scales: Float[Tensor, "n 3"],
        opacity: Float[Tensor, " n"],
    ) -> Any:
        """A search tree over the Gaussians in the object frame, to hand to `trace`, `visible` and `blockers`
        only."""
        ...

    def trace(
        self,
        bvh: Any,
        origins: Float[Tensor, "r 3"],
        directions: Float[Tensor, "r 3"],
        radiance: Float[Tensor, "m 3"],
    ) -> Hits:
        """What rays meet, object frame; not differentiable.

        A Gaussian counts where its peak lies ahead (z > 0), within TRACE_SIGMAS and with alpha >= ALPHA_MIN,
        and where it faces the ray (n.d <= 0). Origins should be lifted off their own surface by the caller.

        Args:
            bvh: From `build`, of the same backend.
            origins: Ray origins [object radius].
            directions: Unit directions.
            radiance: Linear radiance of every Gaussian (m = n), or none (m = 0).
        """
        ...

    def visible(
        self,
        bvh: Any,
        points: Float[Tensor, "p 3"],
        normals: Float[Tensor, "p 3"],
        directions: Float[Tensor, "d 3"],
    ) -> Int32[Tensor, "p words"]:
        """One bit per point and shared direction: bit j % 32 of word j // 32 is set where direction j is
        visible.

        Visible means: above the point's horizon (n.d > 0) and transmittance >= VISIBLE by the rule of
        `trace`.
        """
        ...

    def blockers(
        self,
        bvh: Any,
        points: Float[Tensor, "p 3"],
        normals: Float[Tensor, "p 3"],
        directions: Float[Tensor, "d 3"],
        visibility: Int32[Tensor, "p words"],
    ) -> Int32[Tensor, "p d"]:
        """Which Gaussian (`Hits.hit`) stands in each direction above the horizon that is not visible; -1
        elsewhere."""
        ...

    def shade(
        self,
        normal: Float[Tensor, "p 3"],
        albedo: Float[Tensor, "p 3"],
        roughness: Float[Tensor, " p"],
        view: Float[Tensor, "p 3"],
        directions: Float[Tensor, "d 3"],
        radiance: Float[Tensor, "d 3"],
        visibility: Int32[Tensor, "p words"],
        blocker: Int32[Tensor, "#p #d"],
        blocker_radiance: Float[Tensor, "m 3"],
        f0: float,
    ) -> Float[Tensor, "p 3"]:
        """Reflected radiance under d equal-area directions w_j of the whole sphere, Lambert + GGX.

            L_o = 4 pi / d  sum_j (albedo / pi + f_j) L_j max(n.w_j, 0)
            f_j = F a^2 / (4 pi t^2 g(n.v) g(n.w_j)),  a = r^2,  F = f0 (1 + 24 q(1 - v.h))
            q(m) = 0.9878 m^3 - 3.8886 m^4 + 9.1922 m^5 - 9.6217 m^6 + 4.3303 m^7  (Fresnel's equations, index 1.5)
            t = (|n x H|^2 + a^2 (n.H)^2) / |H|^2,  H = v + w_j,  |H|^2 = 2 (1 + v.w_j),  v.h = |H| / 2
            g(x) = (x + sqrt(a^2 + (1 - a^2) x^2)) / 2 for x > 0, else a / 2,  r = max(roughness, ROUGHNESS_MIN)

        (t is the usual (n.h)^2 (a^2 - 1) + 1, written so that a narrow lobe survives 32 bits.)
        Differentiable in normal, albedo, roughness, view and both radiances; normal and view as free vectors
        in the formulas above. f is 0 for an eye below the horizon (n.v <= 0), and where |H| = 0 (v = -w).

        Args:
            normal: Unit normals.
            albedo: Linear.
            roughness: Perceptual.
            view: Unit directions from surface to camera.
            directions: Unit directions shared by all points, in the frame of normal and view.
            radiance: What arrives from each direction if nothing is in the way.
            visibility: As `visible` packs it: L_j is radiance[j] where the bit is set; where it is not,
                blocker_radiance[blocker[p, j]], or 0 if that is -1.
            blocker: As from `blockers`; `[1 1]` of -1 when what stands in the way is black.
            blocker_radiance: Linear radiance of whatever `blocker` indexes; m may be 0.
            f0: Reflectance at normal incidence.
        """
        ...


def names() -> list[str]:
    """The backends there are, by file name."""
    return sorted(m.name for m in pkgutil.iter_modules(__path__) if not m.name.startswith("_"))


def load(name: str) -> Backend:
    """The backend in file `name`."""
    return cast(Backend, importlib.import_module(f"{__name__}.{name}"))


def choose(device: torch.device, dtype: torch.dtype) -> Backend:
    """The fastest backend for tensors of a device and dtype: the device's own if it is ready, else the
    reference.

    Only float32 has fast kernels; other dtypes are for tests and take the reference in silence. When the
    device's kernels are not ready, one warning says why and what to do.
    """
    if dtype != torch.float32 or device.type not in names():
        return load("reference")
    reason = load(device.type).ready(device, dtype)
    if reason:
        _warn_once(device.type, reason)
        return load("reference")
    return load(device.type)


@cache
def _warn_once(name: str, reason: str) -> None:
    warnings.warn(f"rendering on {name} with the slow reference: {reason}", RuntimeWarning, stacklevel=4)
