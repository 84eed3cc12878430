"""Backends: the interface of rendering and other kernels of a training step, and the choice of an implementation.

`_contract.py` defines the interface; the modules of this folder without a leading underscore implement it. Three
kernels render: **rasterize** (splatting of Gaussians), **trace** (rays against Gaussians) and **shade** (reflected
light). The others replace hundreds of small operations per step: colour (**sh_shade**), materials
(**corner_features**), light (**lookup**, **bounce**) and loss terms (**image_terms**, **gaussian_terms**,
**material_terms**). `reference.py` defines the correct result; the others compute the same, faster. There are no
options: rules for culling, depth and interpolation are part of the method, and other rules need another module. More
kernels are optional: relighting (`RelightKernel`), depth fusion (`FuseKernel`), baking (`BlendKernel`) and bundle
adjustment (`BundleKernel`).

Vocabulary
    *Gaussian*: mean `mu`, rotation `R_q` of its quaternion, standard deviations `s`, opacity `o`. Its third axis
    `n = R_q[:, 2]` is its outward normal. `W = diag(1/s) R_q^T` is its whitening matrix: the Gaussian at x is
    `o exp(-|W(x - mu)|^2/2)`.
    *Peak*: the point of a ray at which a Gaussian is largest. For a ray `x = a + z d`: `z = W(mu - a).Wd / |Wd|^2`.
    Rasterizer and tracer evaluate response, depth and corner coordinates at the peak. This is exact in perspective
    (there is no affine approximation), equals the ray-plane intersection for a thin Gaussian, and its distance from the
    centre is bounded by the response, even for a Gaussian seen edge-on. No screen-space blur is added, so that
    Gaussians much smaller than a pixel may fall between pixel centres.
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
from typing import cast

import torch

from tumble.backends._contract import (
    Backend,
    GlossyGaussians,
    Hits,
    Leaf,
    LightTables,
    Lobes,
    RelightKernel,
    Rendering,
    SampledView,
    ShadingLight,
    SurfaceSamples,
)
from tumble.backends._geometry.contract import (
    BlendKernel,
    BundleKernel,
    BundleObservations,
    BundleVariables,
    Cameras,
    DepthMaps,
    FuseKernel,
    ReducedBundle,
)
from tumble.backends._graphs import CannotRecord, Recorder, Recording, as_recording, recording

__all__ = [
    "ALPHA_MAX",
    "ALPHA_MIN",
    "Backend",
    "BlendKernel",
    "BundleKernel",
    "BundleObservations",
    "BundleVariables",
    "CORNER",
    "Cameras",
    "DepthMaps",
    "FACING",
    "FuseKernel",
    "GlossyGaussians",
    "Hits",
    "NARROW_ROUGHNESS",
    "NEAR",
    "IRRADIANCE_FLOOR",
    "KNEE",
    "Leaf",
    "LightTables",
    "Lobes",
    "NEAR_SIGMAS",
    "NORMAL_GRADIENT",
    "OBJECT",
    "RATIO_MAX",
    "ROUGHNESS_MIN",
    "CannotRecord",
    "Recorder",
    "Recording",
    "ReducedBundle",
    "RelightKernel",
    "Rendering",
    "SATURATED",
    "SSIM_SIGMA",
    "SSIM_STABILISERS",
    "SSIM_WINDOW",
    "SampledView",
    "ShadingLight",
    "SurfaceSamples",
    "TRACE_SIGMAS",
    "TRACE_T_MIN",
    "T_MIN",
    "UNKNOWN",
    "VISIBLE",
    "as_recording",
    "blend_kernel",
    "bundle_kernel",
    "choose",
    "fuse_kernel",
    "load",
    "names",
    "origin_of_kernels",
    "recorder",
    "recording",
    "relight_kernel",
    "threads",
    "threads_for_kernels",
    "usable_device",
    "vector_bits",
]

ALPHA_MAX = 0.99
"""Upper limit of the alpha of one Gaussian, which is clamped and has no gradient beyond."""
ALPHA_MIN = 1 / 255
"""Alpha below which a Gaussian does not contribute to a pixel or ray."""
T_MIN = 1e-4
"""Transmittance below which a pixel is finished; Gaussians behind it do not contribute."""
FACING = -0.01
"""Upper limit of the cosine (p/|p|).n between view direction and normal, with p the centre in the camera frame;
Gaussians above it are back-facing and culled."""
NEAR = 0.05
"""z-depth of the centre below which a Gaussian is culled [object radius]."""
NEAR_SIGMAS = 4.0
"""z-depth of the centre below which a Gaussian is culled [its standard deviations along z]."""
CORNER = 2.0
"""Distance of the corners of a Gaussian's plane from its centre along both axes [standard deviations]; 91 % of its
weight lies between the corners."""
TRACE_SIGMAS = 3.0
"""Distance of the peak from the centre beyond which the tracer ignores a Gaussian [standard deviations]."""
TRACE_T_MIN = 0.03
"""Transmittance below which a ray is blocked: its transmittance becomes 0, its radiance is divided by its opacity."""
VISIBLE = 0.5
"""Minimum transmittance at which a direction is visible from a point."""
ROUGHNESS_MIN = 0.05
"""Lower limit of the roughness used for shading; narrower lobes would fall between the sampled directions."""
NARROW_ROUGHNESS = (0.3, 0.45)
"""Range of roughness over which shading blends from the prefiltered lobe to the sum over directions; below it, a few
hundred directions cannot resolve the lobe."""
NORMAL_GRADIENT = 0.3
"""Factor of the gradient from `sh_shade` to the normals: the low-order light causes errors in the full gradient."""
IRRADIANCE_FLOOR = 0.03
"""Fraction of the mean irradiance that is added to shadowed and unshadowed irradiance before their ratio is taken, as
it is unstable where hardly any light arrives."""
RATIO_MAX = 2.0
"""Upper limit of the ratio of shadowed to unshadowed irradiance, which interreflection can raise above 1."""
SATURATED = 254
"""8-bit value of a photo from which a pixel counts as saturated."""
KNEE = 0.0031308
"""Linear value at which the sRGB curve (IEC 61966-2-1) changes from a line to a power."""
SSIM_WINDOW = 11
"""Width of the Gaussian window of SSIM [pixels]."""
SSIM_SIGMA = 1.5
"""Standard deviation of the Gaussian window of SSIM [pixels]."""
SSIM_STABILISERS = (0.01**2, 0.03**2)
"""Constants C1 and C2 of SSIM (Wang et al. 2004) for values in [0, 1]."""
OBJECT = 255
"""Mask value of pixels that show the object."""
UNKNOWN = 128
"""Mask value of pixels that `image_terms` ignores."""


_threads: ContextVar[int | None] = ContextVar("threads", default=None)


def threads() -> int:
    """Number of threads that kernels on the CPU use: torch's number, or its value before `threads_for_kernels`."""
    return _threads.get() or torch.get_num_threads()


@contextmanager
def threads_for_kernels() -> Iterator[None]:
    """Context in which torch's own operations use one thread, while the kernels keep all threads.

    The tensors of a training step are so small that more threads slow torch's operations down.
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
    """The device with the given name; "auto" is a GPU if there is one whose kernels are ready, else the CPU.

    Raises:
        ValueError: The device is "cuda", and torch finds no NVIDIA GPU.
    """
    if name == "auto":
        gpu = torch.device("cuda")
        return torch.device("cpu") if load("cuda").ready(gpu, torch.float32) else gpu
    if name == "cuda" and not torch.cuda.is_available():
        raise ValueError("--device cuda: torch finds no NVIDIA GPU on this machine; for details run: tumble doctor")
    return torch.device(name)


def vector_bits() -> int:
    """Width of the SIMD vectors of the CPU kernels on this machine [bits]."""
    from tumble.backends import _native

    return 32 * _native.library().lanes()


def origin_of_kernels() -> tuple[str, str]:
    """Where the CPU kernels come from; or what replaces them, and why."""
    from tumble.backends import _native

    try:
        return _native.origin(), ""
    except _native.CannotCompile as reason:
        return "plain torch, hundreds of times slower than compiled kernels", str(reason)


@cache
def names() -> tuple[str, ...]:
    """Names of all backends, which are their file names; the folder is read once."""
    return tuple(sorted(m.name for m in pkgutil.iter_modules(__path__) if not m.name.startswith("_")))


@cache
def load(name: str) -> Backend:
    """The backend with the given name, imported."""
    return cast(Backend, importlib.import_module(f"{__name__}.{name}"))


def choose(device: torch.device, dtype: torch.dtype) -> Backend:
    """The fastest backend for tensors of a device and dtype: that of the device if it is ready, else the reference.

    Fast kernels exist for float32 only; other dtypes, which only tests use, get the reference without a warning. If the
    kernels of the device are not ready, one warning gives the reason and the fix.
    """
    if dtype != torch.float32 or device.type not in names():
        return load("reference")
    reason = load(device.type).ready(device, dtype)
    if reason:
        _warn_once(device.type, reason)
        return load("reference")
    return load(device.type)


def relight_kernel(backend: Backend) -> RelightKernel | None:
    """The kernel of relighting of a backend, None if it has none."""
    return getattr(backend, "relight", None)


def fuse_kernel(backend: Backend) -> FuseKernel | None:
    """The kernel of depth fusion of a backend, None if it has none."""
    return getattr(backend, "fuse", None)


def blend_kernel(backend: Backend) -> BlendKernel | None:
    """The kernel of texture baking of a backend, None if it has none."""
    return getattr(backend, "blend", None)


def bundle_kernel() -> BundleKernel | None:
    """The kernel of bundle adjustment, which runs on the CPU; None if it is not ready."""
    backend = load("cpu")
    return None if backend.ready(torch.device("cpu"), torch.float32) else cast(BundleKernel, backend)


def recorder(device: torch.device) -> Recorder | None:
    """What records steps on a device, to replay them as a whole; None if the device has none, as the CPU."""
    make = getattr(load(device.type), "recorder", None) if device.type in names() else None
    return None if make is None or load(device.type).ready(device, torch.float32) else make(device)


@cache
def _warn_once(name: str, reason: str) -> None:
    warnings.warn(f"rendering on {name} with the slow reference backend: {reason}", RuntimeWarning, stacklevel=4)
