"""CUDA backend: float32 kernels written in NVIDIA Warp (the folder `_warp`).

This file wraps the kernels in `autograd.Function`s. Warp is an optional package and is imported at the first call, when
it compiles the kernels within seconds and caches them. Gradients are summed by atomic additions, so that two runs on a
GPU differ by rounding errors. The kernels run on the device of the tensors; on the CPU they are slow and serve tests.
"""

import importlib.util
from functools import cache
from typing import Any, NamedTuple

import torch
from jaxtyping import Float, Int32
from torch import Tensor
from torch.nn.functional import pad

from tumble.backends import Hits, Rendering
from tumble.backends._cuda_graphs import CudaRecorder
from tumble.backends._cuda_shading import lookup, prefilter, shade, shading_term
from tumble.backends._cuda_terms import (
    activate,
    adam,
    bounce,
    corner_features,
    gaussian_terms,
    image_terms,
    material_terms,
    sh_shade,
)
from tumble.backends._graphs import recording
from tumble.backends._pairs import PairLimit

__all__ = [
    "activate",
    "adam",
    "blockers",
    "bounce",
    "build",
    "corner_features",
    "gaussian_terms",
    "image_terms",
    "lookup",
    "material_terms",
    "pair_limits",
    "prefilter",
    "rasterize",
    "ready",
    "recorder",
    "sh_shade",
    "shade",
    "shading_term",
    "trace",
    "visible",
]


def ready(device: torch.device, dtype: torch.dtype) -> str:
    """Empty if the kernels accept such tensors on this machine, else the reason and the fix."""
    if device.type != "cuda" or dtype != torch.float32:
        return f"the kernels take float32 on an NVIDIA GPU, not {dtype} on {device}"
    if not torch.cuda.is_available():
        return "torch finds no NVIDIA GPU; install the NVIDIA driver and a torch built for CUDA"
    if importlib.util.find_spec("warp") is None:
        return "the kernels need NVIDIA Warp; install it: pip install 'tumble[cuda]'"
    return ""


def recorder(device: torch.device) -> CudaRecorder:
    """See `backends.recorder`."""
    return CudaRecorder(device, pair_limits)


def rasterize(
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
    """One view of the Gaussians; see `Backend.rasterize`. Many features are rendered in several passes."""
    from tumble.backends._warp.compositing import WIDTHS

    camera = torch.cat([R_cam_obj.flatten(), t_cam_obj, fx_fy_cx_cy])
    views = []
    for group in corners.split(max(WIDTHS), 2):
        channels = min(x for x in WIDTHS if x >= group.shape[2])
        padded = pad(group, (0, channels - group.shape[2])) if channels > group.shape[2] else group
        gaussians = means, quats, scales, opacity, sh, padded
        pixels, weight, touched, dominant = _Rasterize.apply(*gaussians, camera, height, width, mask)
        rgb, alpha, depth, depth_var, normal, features = pixels.split([3, 1, 1, 1, 3, channels], -1)
        alpha, depth, depth_var = alpha[..., 0], depth[..., 0], depth_var[..., 0]
        features = features[..., : group.shape[2]]
        views.append(Rendering(rgb, alpha, depth, depth_var, normal, features, weight, touched, dominant))
    if len(views) == 1:
        return views[0]
    return views[0]._replace(features=torch.cat([view.features for view in views], -1))


class _Rasterize(torch.autograd.Function):
    """(means, quats, scales, opacity, sh, corners, camera, height, width, mask) -> pixels, weight, touched, dominant.

    The layouts of camera and pixels are those of `_warp`.
    """

    @staticmethod
    def forward(ctx: Any, *args: Any) -> tuple[Tensor, ...]:
        from tumble.backends._warp import compositing, projection, runtime

        *inputs, height, width, mask = args
        inputs = [x.contiguous() for x in inputs]
        *geometry, corners, camera = inputs
        means, n, channels = geometry[0], len(corners), corners.shape[2]
        record = means.new_empty(n, projection.RECORD, 4)
        depth, n_tiles = means.new_empty(n), _int32(means, n)
        pixels = means.new_empty(height * width, compositing.FIXED + channels)
        weight, touched = means.new_zeros(2, n).unbind()
        statistics = weight, touched.view(torch.int32), _int32(means, height * width)
        with runtime.stream(means.device):
            prepared = record, depth, n_tiles
            runtime.launch(projection.project_forward, n, *geometry, camera, height, width, *prepared)
            limit = _limit(means.device, height, width)
            trains = any(ctx.needs_input_grad)
            if not trains:
                limit.look()
            starts, listed = _bin(*prepared, height, width, limit if trains else None)
            drawing = record, _packed(corners), camera, mask.expand(height, width), starts, listed, height, width
            kernel = compositing.forward(channels)
            runtime.launch(kernel, _threads(starts), *drawing, pixels, *statistics)
        ctx.size = height, width
        ctx.save_for_backward(*inputs, record, n_tiles, starts, listed, pixels)
        ctx.mark_non_differentiable(*statistics)
        weight, touched, dominant = statistics
        return pixels.view(height, width, -1), weight, touched, dominant.view(height, width)

    @staticmethod
    def backward(ctx: Any, v_pixels: Tensor, *_: Any) -> tuple[Tensor | None, ...]:  # type: ignore[override]
        from tumble.backends._warp import compositing, projection, runtime

        means, quats, scales, _, sh, corners, camera, record, n_tiles, starts, listed, pixels = ctx.saved_tensors
        n, channels = len(means), corners.shape[2]
        width = projection.CORNERS + 4 * channels
        v_camera, sums = means.new_zeros(len(camera) + n * width).split([len(camera), n * width])
        v_camera, sums = v_camera[None], sums.view(n, width)
        v_means, v_quats, v_scales, v_sh = (torch.empty_like(x) for x in (means, quats, scales, sh))
        with runtime.stream(means.device):
            drawn = record, _packed(corners), camera, starts, listed, *ctx.size, pixels
            kernel = compositing.adjoint(channels)
            runtime.launch(kernel, _threads(starts), *drawn, v_pixels.reshape(pixels.shape).contiguous(), sums)
            gradients = v_means, v_quats, v_scales, v_sh, v_camera
            inputs = means, quats, scales, sh, camera, n_tiles
            runtime.launch(projection.project_adjoint, runtime.whole_warps(n), *inputs, sums, *gradients)
        v_opacity = sums[:, projection.OPACITY]
        v_corners = sums[:, projection.CORNERS :].view(n, 4, channels)
        return v_means, v_quats, v_scales, v_opacity, v_sh, v_corners, v_camera[0], None, None, None


def _packed(corners: Float[Tensor, "n 4 c"]) -> Float[Tensor, "n 4 c1"]:
    """The corners, or unused ones with one feature if there are none, because Warp has no vectors of length 0."""
    return corners if corners.shape[2] else corners.new_empty(len(corners), 4, 1)


def _threads(starts: Int32[Tensor, " tiles_1"]) -> int:
    """Number of threads of the blending kernels, one per pixel of all tiles."""
    from tumble.backends._warp.projection import TILE

    return (len(starts) - 1) * TILE * TILE


_limits: dict[tuple[torch.device, int, int], PairLimit] = {}
"""Limits of training views by device and size."""


def _limit(device: torch.device, height: int, width: int) -> PairLimit:
    """The limit for views of a size."""
    return _limits.setdefault((device, height, width), PairLimit())


def pair_limits(device: torch.device) -> list[PairLimit]:
    """The limits for views of all sizes so far, in the order of their first view."""
    return [limit for (place, *_), limit in _limits.items() if place.type == device.type]


def _bin(
    record: Float[Tensor, "n 8 4"],
    depth: Float[Tensor, " n"],
    n_tiles: Int32[Tensor, " n"],
    height: int,
    width: int,
    limit: PairLimit | None,
) -> tuple[Int32[Tensor, " tiles_1"], Int32[Tensor, " pairs"]]:
    """Start of the list of each tile (and end of the last), and all lists: Gaussians by depth, ties by index.

    Args:
        record: See `projection`.
        depth: Sorting depth.
        n_tiles: Number of tiles of each Gaussian.
        height: Rows of the image.
        width: Columns of the image.
        limit: Length of the lists; the host waits for the true one if it is None.
    """
    import warp

    from tumble.backends._warp import projection, runtime

    order = torch.argsort(depth, stable=True)
    ends = n_tiles[order].cumsum(0)
    if limit is None or not len(ends):
        room, longest = int(ends[-1]) if len(ends) else 0, _int32(depth, 1)
    else:
        room, longest = limit.room(ends)
    n_all = -(-height // projection.TILE) * -(-width // projection.TILE)
    # Places without a pair count for a tile behind the last. The second half of both is workspace of the sort, which is
    # stable and so keeps the depth order within a tile.
    tiles, listed = _int32(depth, 2 * room).fill_(n_all), _int32(depth, 2 * room)
    pairs = tiles[:room], listed[:room]
    runtime.launch(projection.list_tiles, len(order), order, ends, record, n_tiles, height, width, *pairs, longest)
    if recording():  # Warp's sort, which looks at fewer bits, would allocate memory of its own
        in_order, of_sorted = pairs[0].sort(stable=True)
        pairs = in_order, pairs[1][of_sorted]
    else:
        warp.utils.radix_sort_pairs(warp.from_torch(tiles), warp.from_torch(listed), room, end_bit=n_all.bit_length())
    starts = torch.searchsorted(pairs[0], _all_tiles(n_all, depth.device), out_int32=True)
    return starts, pairs[1]


@cache
def _all_tiles(n: int, device: torch.device) -> Int32[Tensor, " n_1"]:
    """Indices of n tiles, and n."""
    return torch.arange(n + 1, dtype=torch.int32, device=device)


class WarpBvh(NamedTuple):
    """The result of `build`: a search tree and its memory."""

    boxes: Any
    """Bounding boxes of the Gaussians as a `warp.Bvh`."""
    record: Float[Tensor, "n 4 4"]
    """Records of the Gaussians, see `tracing`."""
    low: Float[Tensor, "n 3"]
    """Lower corners of the boxes, to which `boxes` points."""
    high: Float[Tensor, "n 3"]
    """Upper corners of the boxes, to which `boxes` points."""


@torch.no_grad()
def build(
    means: Float[Tensor, "n 3"],
    quats: Float[Tensor, "n 4"],
    scales: Float[Tensor, "n 3"],
    opacity: Float[Tensor, " n"],
) -> WarpBvh:
    """See `Backend.build`."""
    import warp

    from tumble.backends._warp import runtime, tracing

    # Warp's tree cannot be empty, so that without Gaussians it holds one box that no ray reaches.
    n = max(len(means), 1)
    record = means.new_zeros(n, 4, 4)
    low, high = means.new_full((n, 3), tracing.UNREACHABLE), means.new_full((n, 3), tracing.UNREACHABLE)
    with runtime.stream(means.device):
        gaussians = [x.contiguous() for x in (means, quats, scales, opacity)]
        runtime.launch(tracing.enclose, len(means), *gaussians, record, low, high)
        # Of Warp's constructors on a GPU that whose trees are traced fastest (docs/experiments/constants.md).
        boxes = warp.Bvh(warp.from_torch(low, warp.vec3), warp.from_torch(high, warp.vec3), constructor="cubql")
    return WarpBvh(boxes, record, low, high)


@torch.no_grad()
def trace(
    bvh: WarpBvh,
    origins: Float[Tensor, "r 3"],
    directions: Float[Tensor, "r 3"],
    radiance: Float[Tensor, "m 3"],
) -> Hits:
    """See `Backend.trace`."""
    from tumble.backends._warp import runtime, tracing

    n = len(origins)
    hits = Hits(origins.new_empty(n), origins.new_empty(n, 3), _int32(origins, n))
    with runtime.stream(origins.device):
        rays = [x.contiguous() for x in (radiance, origins, directions)]
        runtime.launch(tracing.trace_rays, n, bvh.boxes.id, bvh.record, *rays, *hits)
    return hits


@torch.no_grad()
def visible(
    bvh: WarpBvh,
    points: Float[Tensor, "p 3"],
    normals: Float[Tensor, "p 3"],
    directions: Float[Tensor, "d 3"],
) -> Int32[Tensor, "p words"]:
    """See `Backend.visible`."""
    from tumble.backends._warp import runtime, tracing

    words = -(-len(directions) // 32)
    bits = _int32(points, len(points), words)
    with runtime.stream(points.device):
        inputs = [x.contiguous() for x in (points, normals, directions)]
        runtime.launch(tracing.trace_visibility, (len(points), 32 * words), bvh.boxes.id, bvh.record, *inputs, bits)
    return bits


@torch.no_grad()
def blockers(
    bvh: WarpBvh,
    points: Float[Tensor, "p 3"],
    normals: Float[Tensor, "p 3"],
    directions: Float[Tensor, "d 3"],
    visibility: Int32[Tensor, "p words"],
) -> Int32[Tensor, "p d"]:
    """See `Backend.blockers`."""
    from tumble.backends._warp import runtime, tracing

    blocker = _int32(points, len(points), len(directions))
    with runtime.stream(points.device):
        inputs = [x.contiguous() for x in (points.new_zeros(0, 3), points, normals, directions, visibility)]
        threads = len(directions), len(points)
        runtime.launch(tracing.find_blockers, threads, bvh.boxes.id, bvh.record, *inputs, blocker)
    return blocker


def _int32(like: Tensor, *shape: int) -> Int32[Tensor, "..."]:
    return torch.empty(shape, dtype=torch.int32, device=like.device)
