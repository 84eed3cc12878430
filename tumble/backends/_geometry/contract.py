"""The interface of the kernels of depth fusion, texture baking and bundle adjustment, which a backend may lack."""

from typing import Any, NamedTuple, Protocol, runtime_checkable

from jaxtyping import Float, Float64, Int32, Int64
from torch import Tensor


class Cameras(NamedTuple):
    """Cameras around the object with common intrinsics."""

    R: Float[Tensor, "v 3 3"]
    """Rotations from the object frame to the camera frame."""
    t: Float[Tensor, "v 3"]
    """Translations from the object frame to the camera frame [object radius]."""
    positions: Float[Tensor, "v 3"]
    """Positions of the cameras, object frame [object radius]."""
    fx_fy_cx_cy: Float[Tensor, "4"]
    """Focal lengths and principal point [pixels]."""


class DepthMaps(NamedTuple):
    """Depth maps of all views, with planes only for pixels that show a surface."""

    index: Int32[Tensor, "v h w"]
    """Per pixel the row of its plane; -1 in unknown pixels, -2 in pixels that show free space."""
    planes: Float[Tensor, "k 5"]
    """Outward unit normal and offset of the tangent plane, object frame, and z-depth [object radius]."""


@runtime_checkable
class FuseKernel(Protocol):
    """Optional function `fuse` of a backend: `export.depth_fusion.sums_by_operations`, its definition, in one."""

    def __call__(
        self,
        points: Float[Tensor, "n 3"],
        maps: DepthMaps,
        cameras: Cameras,
        *,
        cell: float,
        reach: float,
        distance: float,
    ) -> Float[Tensor, "5 n"]:
        """The sums of depth fusion at points; not differentiable.

        Args:
            points: Points, object frame.
            maps: Depth maps of the cameras.
            cameras: Poses and intrinsics.
            cell: Unit of the distances [object radius].
            reach: Distance from a surface up to which a map counts [cells].
            distance: Distance of the cameras from the centre [object radius].
        """
        ...


@runtime_checkable
class BlendKernel(Protocol):
    """Optional function `blend` of a backend: `export.bake.blend_by_operations`, its definition, in one."""

    def __call__(
        self,
        total: Float[Tensor, "n 7"],
        weights: Float[Tensor, " n"],
        maps: Float[Tensor, "h w 9"],
        camera: Cameras,
        points: Float[Tensor, "n 3"],
        normals: Float[Tensor, "n 3"],
        *,
        min_cosine: float,
        tolerance: float,
    ) -> None:
        """Add a view's maps to weighted sums at points; not differentiable.

        Args:
            total: Weighted sums of the values, to which is added.
            weights: Sums of the weights, to which is added.
            maps: Seven values and the z-depth in pixels that show one surface, then 1; 0 in other pixels.
            camera: Pose and intrinsics of the view.
            points: Points, object frame.
            normals: Outward unit normals of the surface at the points.
            min_cosine: Cosine between normal and view direction above which a view counts.
            tolerance: Maximum difference to the depth of the map at which a point is visible [object radius].
        """
        ...


class BundleObservations(NamedTuple):
    """Observations of points by cameras in `g` groups that share neither; observations are sorted by point, and points
    by group."""

    camera: Int64[Tensor, " o"]
    """Camera of every observation, numbered over all groups, each of which has as many."""
    uv: Float64[Tensor, "o 2"]
    """Observed position [pixels]."""
    weight: Float64[Tensor, " o"]
    point: Int64[Tensor, " n"]
    """Index of every point in `BundleVariables.X`, in this order."""
    first_observation: Int64[Tensor, " n+1"]
    """First observation of every point, and the number of all."""
    first_point: Int64[Tensor, " g+1"]
    """First point of every group, and the number of all."""
    principal: tuple[float, float]
    """Principal point cx, cy [pixels]."""
    scale: float
    """Scale s of the Cauchy loss w s^2 log(1 + |r|^2 / s^2) of a reprojection error r [pixels]."""
    min_depth: float
    """Lower limit of a point's depth in projections."""


class BundleVariables(NamedTuple):
    """Cameras, and points with a prior, prior |X|^2."""

    R: Float64[Tensor, "c 3 3"]
    t: Float64[Tensor, "c 3"]
    focal: Float64[Tensor, "c 2"]
    """Focal lengths fx, fy [pixels]."""
    X: Float64[Tensor, "n 3"]
    prior: Float64[Tensor, " g"]
    """Weight of the prior on the points of every group."""


class ReducedBundle(NamedTuple):
    """Gauss-Newton normal equations of the cameras, and what the elimination of the damped points subtracts.

    Parameters of a camera are a rotation vector applied from the left, and a translation. The logarithm of the focal
    length is one more parameter of every group, on which the prior of the points depends by its square.
    """

    U: Float64[Tensor, "c 6 6"]
    """Diagonal blocks of the cameras, without damping."""
    g_camera: Float64[Tensor, "c 6"]
    """Gradient by the cameras."""
    E: Float64[Tensor, "g m m"]
    """Subtracted from the blocks, for all parameters of a group's cameras."""
    e: Float64[Tensor, "c 6"]
    """Subtracted from the gradient."""
    focal_camera: Float64[Tensor, "c 6"] | None
    """Entries that couple the focal length with the cameras; None if it is known."""
    focal_e: Float64[Tensor, "c 6"] | None
    """Subtracted from them."""
    focal_sums: Float64[Tensor, "g 4"] | None
    """Diagonal entry and gradient of the focal length, and what is subtracted from both."""
    points: Any
    """What `bundle_move` needs of the points."""


@runtime_checkable
class BundleKernel(Protocol):
    """Optional functions of a backend for bundle adjustment, in float64; `poses.sfm.bundle_adjustment` defines them."""

    def bundle_cost(self, observations: BundleObservations, variables: BundleVariables) -> Float64[Tensor, " g"]:
        """Loss and prior of the points of every group."""
        ...

    def bundle_reduce(
        self,
        observations: BundleObservations,
        variables: BundleVariables,
        damping: Float64[Tensor, " g"],
        *,
        focal_free: bool,
    ) -> ReducedBundle:
        """Normal equations without points, whose diagonal entries d become d + damping d + 1e-9."""
        ...

    def bundle_move(
        self,
        observations: BundleObservations,
        reduced: ReducedBundle,
        d_camera: Float64[Tensor, "c 6"],
        d_focal: Float64[Tensor, " g"] | None,
    ) -> Float64[Tensor, "n 3"]:
        """Steps of the points that follow from those of the cameras and of the logarithms of the focal lengths."""
        ...
