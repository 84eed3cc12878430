"""The interface of a backend: its functions, with the formulas that they compute, and their results.

Vocabulary and conventions are those of `tumble.backends`, whose constants appear here in capitals.
"""

from collections.abc import Sequence
from typing import Any, NamedTuple, Protocol, runtime_checkable

import torch
from jaxtyping import Float, Float64, Int32, Int64, UInt8
from torch import Tensor


class Rendering(NamedTuple):
    """One rendered view. The *mean* of x is sum w_i x_i / sum w_i, with the blending weights
    w_i = alpha_i prod_{j in front} (1 - alpha_j), and 0 where all weights are 0."""

    rgb: Float[Tensor, "h w 3"]
    """Linear radiance over black: sum w_i c_i, not divided by alpha."""
    alpha: Float[Tensor, "h w"]
    """Coverage: sum w_i, which is 0 or at least ALPHA_MIN."""
    depth: Float[Tensor, "h w"]
    """Mean z-depth of the peaks, camera frame [object radius]."""
    depth_var: Float[Tensor, "h w"]
    """Variance of the z-depth [object radius^2], summed about t_cam_obj.z to avoid cancellation in float32."""
    normal: Float[Tensor, "h w 3"]
    """Mean outward normal, object frame; shorter than 1 where the normals of Gaussians differ."""
    features: Float[Tensor, "h w c"]
    """Mean of the features, each interpolated at the peak between the four corners of its Gaussian."""
    weight: Float[Tensor, " n"]
    """Sum of w_i over all pixels. Not differentiable."""
    touched: Int32[Tensor, " n"]
    """Number of pixels within the mask to which the Gaussian contributes."""
    dominant: Int32[Tensor, "h w"]
    """Index of the Gaussian with the largest w_i in each pixel, -1 where there is none."""


class Hits(NamedTuple):
    """Result of tracing rays."""

    transmittance: Float[Tensor, " r"]
    """prod (1 - alpha_i); 0 for a blocked ray."""
    radiance: Float[Tensor, "r 3"]
    """sum w_i radiance_i over black, front to back in order of the peaks; zeros if no radiance was given."""
    hit: Int32[Tensor, " r"]
    """Index of the Gaussian with the largest w_i, -1 if the ray hits none."""


class Lobes(NamedTuple):
    """Radiance reflected by surface points, by lobe."""

    diffuse: Float[Tensor, "p 3"]
    """Of a Lambertian lobe with albedo 1, which is irradiance / pi."""
    specular: Float[Tensor, "p 3"]
    """Of the specular lobe with reflectance 1 at normal incidence."""
    specular_visibility: Float[Tensor, " p"]
    """Visible fraction of the specular lobe. Not differentiable."""


class SampledView(NamedTuple):
    """A view with the material of `Backend.corner_features`, and the pixels that `Backend.shading_term` shades."""

    features: Float[Tensor, "h w 7"]
    """Albedo, roughness and normal offset."""
    alpha: Float[Tensor, "h w"]
    normal: Float[Tensor, "h w 3"]
    """Outward normals of any length, object frame, without the offset."""
    dominant: Int32[Tensor, "h w"]
    """Row of visibility and blockers of each pixel; a negative one counts as 0."""
    photo: UInt8[Tensor, "h w 3"]
    """Input image, sRGB."""
    pixels: Int64[Tensor, " p"]
    """Indices of the pixels, counted row by row; a negative one adds nothing to the sum."""


class ShadingLight(NamedTuple):
    """Light and occlusion of `Backend.shading_term`, with arguments of `lookup`, `shade` and `bounce`."""

    stack: Float[Tensor, "levels map_h map_w 3"]
    directions: Float[Tensor, "d 3"]
    """Evenly distributed unit directions, object frame."""
    visibility: Int32[Tensor, "q words"]
    blocker: Int32[Tensor, "#q #d"]
    albedo: Float[Tensor, "n 3"]
    """Albedo of all Gaussians; none (n = 0) for black blockers."""
    transfer: Float[Tensor, "n 9"]
    table: Float[Tensor, "size size"]
    """Directional albedo of the specular lobe divided by f0, by n.v (0 to 1) and roughness (ROUGHNESS_MIN to 1)."""


class Leaf(NamedTuple):
    """A parameter that `Backend.adam` moves, in place; its tensors are contiguous and have one shape."""

    value: Tensor
    gradient: Tensor
    first: Tensor
    """Running mean of the gradient."""
    second: Tensor
    """Running mean of the gradient's square."""
    count: Float[Tensor, ""]
    """Number of steps so far, in float32; advanced in place."""
    rate: float | Float[Tensor, ""]
    """Learning rate: a number, or a float32 on the device, which a recording of the step reads."""


@runtime_checkable
class Backend(Protocol):
    """Interface of a backend module. All float tensors of a call share one device and dtype; sizes may be zero."""

    def ready(self, device: torch.device, dtype: torch.dtype) -> str:
        """Empty if this backend can process tensors of that device and dtype now, else the reason and the fix."""
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
        """One view of the Gaussians; differentiable in every float input except the mask.

        Gaussians are sorted by the z-depth of their centres, ties by index, and blended front to back. Those with
        z < NEAR, z < NEAR_SIGMAS * (standard deviation along z), or a normal that does not face the camera (FACING)
        are culled. The gradient of `R_cam_obj` is that of its nine numbers as independent variables
        (`W = diag(1/s) R_q^T R_cam_obj^T`, view direction `R_cam_obj^T p`); the caller's parametrisation of rotations
        projects it.

        Args:
            means: Centres, object frame [object radius].
            quats: Rotations from local to object frame, wxyz, of any length except 0.
            scales: Standard deviations along the local axes, > 0; the third is the thickness.
            opacity: In [0, 1].
            sh: Spherical harmonics of the radiance c = max(0, sum_k Y_k(v) sh_k), where v is the object-frame direction
                from the camera to the centre, and k is 1, 4, 9 or 16. Y has the order and signs of 3D Gaussian
                splatting (Y_1.. = -y, z, -x times .4886). With k = 1 and sh = c / 0.28209479 any radiance c computed
                elsewhere can be passed. A negative sum gives black without a gradient, so colours should be initialised
                positive.
            corners: Features at (-,-), (+,-), (-,+), (+,+) CORNER standard deviations along the first two axes,
                interpolated bilinearly between the corners and constant beyond; c may be 0.
            R_cam_obj: Rotation from object to camera.
            t_cam_obj: Translation from object to camera [object radius].
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
        """A search tree over the Gaussians, object frame: an opaque argument of `trace`, `visible` and `blockers`."""
        ...

    def trace(
        self,
        bvh: Any,
        origins: Float[Tensor, "r 3"],
        directions: Float[Tensor, "r 3"],
        radiance: Float[Tensor, "m 3"],
    ) -> Hits:
        """Trace rays against the Gaussians, object frame; not differentiable.

        A Gaussian is hit if its peak lies ahead (z > 0), within TRACE_SIGMAS and with alpha >= ALPHA_MIN, and if it
        faces the ray (n.d <= 0). The caller should offset origins from the surface they lie on.

        Args:
            bvh: Result of `build` of the same backend.
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
        """Visibility of directions shared by all points: bit j % 32 of word j // 32 is set if direction j is visible.

        A direction is visible if it is above the point's horizon (n.d > 0) and its transmittance by `trace` is at least
        VISIBLE.
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
        """Index of the Gaussian (`Hits.hit`) in each direction above the horizon that is not visible; -1 elsewhere."""
        ...

    def shade(
        self,
        normal: Float[Tensor, "p 3"],
        roughness: Float[Tensor, " p"],
        view: Float[Tensor, "p 3"],
        directions: Float[Tensor, "d 3"],
        radiance: Float[Tensor, "d 3"],
        visibility: Int32[Tensor, "q words"],
        blocker: Int32[Tensor, "#q #d"],
        rows: Int64[Tensor, " p"],
        blocker_radiance: Float[Tensor, "m 3"],
    ) -> Lobes:
        """Reflected radiance (Lambert and GGX) under light from d directions w_j of equal solid angle over the sphere.

            diffuse = 4 / d  sum_j L_j max(n.w_j, 0),  specular = 4 pi / d  sum_j f_j L_j max(n.w_j, 0)
            f_j = F a^2 / (4 pi t^2 g(n.v) g(n.w_j)),  a = r^2,  F = 1 + 24 q(1 - v.h)
            q(m) = 0.9878 m^3 - 3.8886 m^4 + 9.1922 m^5 - 9.6217 m^6 + 4.3303 m^7  (Fresnel's equations, index 1.5)
            t = (|n x H|^2 + a^2 (n.H)^2) / |H|^2,  H = v + w_j,  |H|^2 = 2 (1 + v.w_j),  v.h = |H| / 2
            g(x) = (x + sqrt(a^2 + (1 - a^2) x^2)) / 2 for x > 0, else a / 2,  r = max(roughness, ROUGHNESS_MIN)

        (t is the usual (n.h)^2 (a^2 - 1) + 1 in a form without cancellation for narrow lobes in float32.)
        specular_visibility is the mean of the visibility bits over the directions with n.w > 0, weighted by
        c / ((1 - c) / 2 + b^2 (1 + c) / 2)^2 with c = max(0, m.w), m = 2 (n.v) n - v, and b = max(a, sqrt(pi / d) / 2):
        neighbouring directions are sqrt(4 pi / d) apart, and GGX falls to a quarter at a distance of 2 a from its peak.
        It is 0 if all weights are.

        diffuse and specular are differentiable in normal, roughness, view and both radiances; normal and view count as
        independent vectors in the formulas above. f is 0 for a camera below the horizon (n.v <= 0), and where |H| = 0
        (v = -w).

        Args:
            normal: Unit normals.
            roughness: Perceptual roughness.
            view: Unit directions from surface to camera.
            directions: Unit directions shared by all points, in the frame of normal and view.
            radiance: Linear radiance arriving from each direction where it is visible.
            visibility: Bits of `visible`. L_j is radiance[j] where the bit is set; elsewhere it is
                blocker_radiance[blocker[q, j]], or 0 if blocker[q, j] is -1.
            blocker: Result of `blockers`, or `[1 1]` of -1 for black blockers.
            rows: Row q of visibility and blocker that belongs to each point.
            blocker_radiance: Linear radiance of the Gaussians that `blocker` indexes; m may be 0.
        """
        ...

    def lookup(
        self,
        stack: Float[Tensor, "levels h w 3"],
        directions: Float[Tensor, "p 3"],
        roughness: Float[Tensor, " p"],
    ) -> Float[Tensor, "p 3"]:
        """Values of a stack of equirectangular maps in given directions, at level `roughness (levels - 1)`.

        Linear between levels and bilinear between texels (convention of docs/format.md), continuous across the seam and
        the poles. Differentiable in all arguments, except for the direction at a pole.

        Args:
            stack: Maps of levels 0 to `levels - 1`; w is even.
            directions: Directions of any length except 0.
            roughness: Clamped to [0, 1].
        """
        ...

    def sh_shade(
        self,
        means: Float[Tensor, "n 3"],
        quats: Float[Tensor, "n 4"],
        albedo_logits: Float[Tensor, "n 3"],
        light: Float[Tensor, "2 16 3"],
        specular_scale: Float[Tensor, ""],
        occluded: Float[Tensor, "m 9"],
        unoccluded: Float[Tensor, "m 9"],
        directions: Float[Tensor, "d 3"],
        reflectance: Float[Tensor, " k"],
        R_env_obj: Float[Tensor, "3 3"],
        position: Float[Tensor, "3"],
    ) -> Float[Tensor, "n 3"]:
        """Linear radiance of Gaussians towards the camera under a light of spherical harmonics.

            c = sigmoid(albedo_logits) rho E(R n) + specular_scale F(n.v) S(R r),  r = 2 (n.v) n - v
            E(d) = softplus(sum_k light_0k Y_k(d)),  S(d) = softplus(sum_k light_1k Y_k(d)),
            F(x) = sum_k reflectance_k (1 - min(1, x))^k,  R = R_env_obj,  v = normalize(position - mean)

        c is 0 where n.v <= 0, since `rasterize` culls these Gaussians. rho is irradiance with self-shadowing divided
        by that without, `(H(occluded) + f) / (H(unoccluded) + f)` but at most RATIO_MAX, and 1 if m is 0.
        H(t) = max(0, t . q) / max(1e-3, 1 - albedo (1 - min(1, max(0, t_0 sqrt(4 / pi))))) includes all bounces, with
        q_k the mean over the directions w of 4 pi Y_k(w) S(R w), and f is IRRADIANCE_FLOOR pi times the mean of S(R w).

        Differentiable in means, quaternions, albedo, light, specular scale, R_env_obj (its nine numbers as independent
        variables) and position, with rho as a constant and the gradient of the normals times NORMAL_GRADIENT.

        Args:
            means: Centres, object frame.
            quats: Rotations from local to object frame, of which only the normal n (third axis) is used.
            albedo_logits: Linear albedo before the sigmoid.
            light: Coefficients of E and S, env frame.
            specular_scale: Scale of the specular lobe.
            occluded: Transfer vectors from light to irradiance with self-shadowing (m = n), or none (m = 0).
            unoccluded: Transfer vectors without self-shadowing.
            directions: Evenly distributed unit directions, object frame, for the integral of S.
            reflectance: Coefficients of a polynomial in 1 - n.v.
            R_env_obj: Rotation from the object frame to the env frame.
            position: Camera centre, object frame.
        """
        ...

    def image_terms(
        self,
        rgb: Float[Tensor, "h w 3"],
        alpha: Float[Tensor, "h w"],
        depth: Float[Tensor, "h w"],
        depth_var: Float[Tensor, "h w"],
        normal: Float[Tensor, "h w 3"],
        photo: UInt8[Tensor, "h w 3"],
        mask: UInt8[Tensor, "h w"],
        R_cam_obj: Float[Tensor, "3 3"],
        fx_fy_cx_cy: Float[Tensor, "4"],
        ssim_weight: float,
        crease: float,
        weights: Sequence[float] = (1.0, 1.0, 1.0, 1.0),
    ) -> Float[Tensor, "4"]:
        """Weighted loss terms of a rendered view (`Rendering`) against a photo, each a mean over the image.

        0. `(1 - w) |x - y| + w (1 - SSIM(x, y))`, w = ssim_weight, with x the rendering in sRGB and y the photo, both
           black where the mask is UNKNOWN; SSIM is averaged over windows within the image. Where the photo is SATURATED
           and x larger, x = y. Differentiable in rgb.
        1. `(alpha - [mask is OBJECT])^2`, 0 where the mask is UNKNOWN. Differentiable in alpha.
        2. `u / (1 + crease u)`, u = 1 - cosine between the normal and the normal of the depth map by central
           differences, where a pixel and its four neighbours have alpha > 1/2. The normal of the depth map is that of
           the surface z (X, Y, 1) with z_x = (z_right - z_left) / 2 and z_y likewise, at the mean of both neighbours.
           Differentiable in normal, depth and R_cam_obj.
        3. `sqrt(max(0, depth_var) + 1e-6) - 1e-3`, 0 where alpha is 0. Differentiable in depth_var.

        The images have at least SSIM_WINDOW rows and columns, and rgb is black where alpha is 0.

        Args:
            rgb: Linear radiance.
            alpha: Coverage.
            depth: Mean z-depth, camera frame.
            depth_var: Variance of the z-depth.
            normal: Outward normals of any length, object frame.
            photo: Input image, sRGB.
            mask: OBJECT, UNKNOWN, or other values beside the object.
            R_cam_obj: Rotation from object to camera.
            fx_fy_cx_cy: Focal lengths and principal point [pixels].
            ssim_weight: Weight of SSIM in the first term, 0 to 1.
            crease: Saturation of the third term.
            weights: Factors of the terms.
        """
        ...

    def gaussian_terms(
        self,
        means: Float[Tensor, "n 3"],
        quats: Float[Tensor, "n 4"],
        log_scales: Float[Tensor, "n 3"],
        sdf: Float[Tensor, " n"],
        gamma: Float[Tensor, ""],
        weight: Float[Tensor, " n"],
        depth: Float[Tensor, "h w"],
        R_cam_obj: Float[Tensor, "3 3"],
        t_cam_obj: Float[Tensor, "3"],
        fx_fy_cx_cy: Float[Tensor, "4"],
        floor: float,
        reach: float,
        weights: Sequence[float] = (1.0, 1.0, 1.0),
    ) -> Float[Tensor, "3"]:
        """Weighted loss terms of the Gaussians.

        0. Mean of `max(0, -log(max(1e-4, exp(H) - 1)))`, with H the entropy of the squared scales divided by their sum,
           plus the mean third scale. Differentiable in log_scales.
        1. `max(0, 1.762747 / max(floor, m) - gamma)`, with m the lower median of |sdf|. Differentiable in gamma.
        2. Mean of |z - depth(u)| over the Gaussians with weight > 0, where z is the z-depth of `mean - sdf normal` and
           u its pixel; a difference of at least `reach`, or a depth of 0, counts as 0. depth is interpolated bilinearly
           between pixel centres. Differentiable in means, quats, sdf, R_cam_obj and t_cam_obj, not in depth.

        All terms are 0 if there are no Gaussians.

        Args:
            means: Centres, object frame.
            quats: Rotations from local to object frame, of which only the normal (third axis) is used.
            log_scales: Logarithms of the standard deviations.
            sdf: Signed distances.
            gamma: Sharpness of the opacity.
            weight: Blending weight of every Gaussian in the view.
            depth: Rendered depth of the view.
            R_cam_obj: Rotation from object to camera.
            t_cam_obj: Translation from object to camera.
            fx_fy_cx_cy: Focal lengths and principal point [pixels].
            floor: Lower limit of the median distance.
            reach: Limit of the depth difference.
            weights: Factors of the terms.
        """
        ...

    def activate(
        self, log_scales: Float[Tensor, "n 3"], sdf: Float[Tensor, " n"], gamma: Float[Tensor, ""]
    ) -> tuple[Float[Tensor, "n 3"], Float[Tensor, " n"]]:
        """Standard deviations `exp(log_scales)` and opacities `4 s (1 - s)`, s = sigmoid(-gamma sdf), of Gaussians.

        Differentiable in all arguments.
        """
        ...

    def adam(
        self, leaves: Sequence[Leaf], loss: Tensor, failed: Tensor, beta_1: float, beta_2: float, eps: float
    ) -> None:
        """One step of Adam (Kingma and Ba 2015) on all leaves at once; the host does not wait for it.

        With bias-corrected moments m and v, a value moves by -rate m / (sqrt(v) + eps). `failed`, a float32, is set to
        1 if the loss or a gradient is not finite. If it is 1, nothing else is changed.
        """
        ...

    def corner_features(
        self,
        albedo_logits: Float[Tensor, "n 4 3"],
        roughness_logits: Float[Tensor, "n 4"],
        normal_offset: Float[Tensor, "n 4 3"],
        temperature: float,
    ) -> tuple[Float[Tensor, "n 4 7"], Float[Tensor, "n 3"]]:
        """Features of all corners for `rasterize`, and the mean albedo of every Gaussian.

        The features are albedo, roughness and normal offset, with sigmoid(x / temperature) of both logits.
        Differentiable in all tensors.
        """
        ...

    def bounce(
        self,
        albedo: Float[Tensor, "n 3"],
        transfer: Float[Tensor, "n 9"],
        directions: Float[Tensor, "d 3"],
        radiance: Float[Tensor, "d 3"],
    ) -> Float[Tensor, "n 3"]:
        """Radiance `albedo / pi H(transfer)` of surfaces, with the irradiance H of `sh_shade` including all bounces.

        Its q_k is the mean over the directions w of 4 pi Y_k(w) times their radiance. Differentiable in albedo and
        radiance.

        Args:
            albedo: Linear albedo.
            transfer: Transfer vectors from light to shadowed irradiance.
            directions: Evenly distributed unit directions.
            radiance: Light from these directions.
        """
        ...

    def shading_term(
        self,
        view: SampledView,
        light: ShadingLight,
        R_cam_obj: Float[Tensor, "3 3"],
        R_env_obj: Float[Tensor, "3 3"],
        fx_fy_cx_cy: Float[Tensor, "4"],
        f0: Float[Tensor, "3"],
    ) -> Float[Tensor, ""]:
        """Mean over pixels and channels of |x - y|, x = sRGB(alpha L), with the reflected radiance L, and y the photo.

            L = albedo diffuse + f0 (s specular + (1 - s) specular_visibility G(n.v, roughness) S(m, roughness))

        The lobes and specular_visibility are those of `shade` with the normal n = normalize(normal + offset), the
        direction v to the camera, radiance S(w, d^(-1/4)) from the d directions w, and that of `bounce` from blockers.
        m = 2 (n.v) n - v, S is `lookup` in the direction R_env_obj m, and G is bilinear in the table. s rises from 0 to
        1 over NARROW_ROUGHNESS. Where the photo is SATURATED and x larger, x = y.

        Differentiable in features, alpha, normal, stack, albedo of the Gaussians, f0, and both rotations.

        Args:
            view: View, photo and pixels.
            light: Light and occlusion.
            R_cam_obj: Rotation from object to camera.
            R_env_obj: Rotation from the object frame to the env frame.
            fx_fy_cx_cy: Focal lengths and principal point [pixels].
            f0: Reflectance at normal incidence.
        """
        ...

    def prefilter(self, radiance: Float[Tensor, "h w 3"], lobes: Float[Tensor, "f rows h"]) -> Float[Tensor, "out w 3"]:
        """A map, and below it `rows` convolutions along its columns; differentiable in radiance.

        lobes[:, i, j] is the real Fourier transform, f = w / 2 + 1 numbers, of the lobe from row j to row i; w is even.
        """
        ...

    def material_terms(
        self,
        features: Float[Tensor, "h w c"],
        alpha: Float[Tensor, "h w"],
        photo: UInt8[Tensor, "h w 3"],
        mask: UInt8[Tensor, "h w"],
    ) -> Float[Tensor, "2"]:
        """Loss terms of a rendered material.

        0. The mask term of `image_terms`. Differentiable in alpha.
        1. Mean of |x_b - x_a| e^-|y_b - y_a| over pairs of neighbours a and b along rows, plus that along columns. x
           are the first four features where the mask is OBJECT and alpha > 1/2, and 0 elsewhere; y is the photo divided
           by 255, and the exponential is averaged over its channels. Differentiable in features.
        """
        ...


class SurfaceSamples(NamedTuple):
    """Surface points of Monte Carlo shading, object frame, and the samples of all points."""

    origins: Float[Tensor, "p 3"]
    """Origins of rays, offset from the surface."""
    normals: Float[Tensor, "p 3"]
    """Outward unit normals."""
    views: Float[Tensor, "p 3"]
    """Unit directions to the camera."""
    albedo: Float[Tensor, "p 3"]
    """Linear albedo."""
    roughness: Float[Tensor, "p 1"]
    """Perceptual roughness."""
    shift: Float[Tensor, "p 3"]
    """Shift of the lattice of each point; the uniform numbers of a sample are `(lattice + shift) % 1`."""
    lattice: Float[Tensor, "n 3"]
    """Points in the unit cube: those of samples of the BRDF, then those of samples of the light."""


class LightTables(NamedTuple):
    """An equirectangular light with tables for sampling it, in the env frame.

    Sample u is in the first row of cells whose cumulative probability exceeds `u[0]`, and in the cell of that row in
    which the probability exceeds `u[1]` times that of the row. A guide holds the index of the first bin whose
    cumulative probability exceeds that of evenly spaced numbers 0 to 1, both included.
    """

    radiance: Float[Tensor, "h w 3"]
    """Linear radiance."""
    density: Float[Tensor, "rows columns"]
    """Density of each cell [1 / steradian]."""
    cumulative: Float64[Tensor, " cells"]
    """Cumulative probability of the cells, row by row."""
    cosines: Float64[Tensor, " rows+1"]
    """Cosines of the polar angles between rows."""
    row_guide: Int32[Tensor, " row_buckets+1"]
    """First row for values of `u[0]`."""
    column_guide: Int32[Tensor, "rows column_buckets+1"]
    """First cell for values of `u[1]` in each row."""


class GlossyGaussians(NamedTuple):
    """Radiance of the Gaussians that occlude light: a diffuse part, and a specular lobe by the split sum."""

    radiance: Float[Tensor, "n 3"]
    """Diffuse linear radiance."""
    normals: Float[Tensor, "n 3"]
    """Outward unit normals, object frame."""
    roughness: Float[Tensor, "n 1"]
    """Perceptual roughness."""
    stack: Float[Tensor, "levels stack_h stack_w 3"]
    """Prefiltered light as in `Backend.lookup`; `LightTables.radiance` replaces level 0 where it is finer."""
    table: Float[Tensor, "size size"]
    """Directional albedo of the specular lobe divided by f0, by n.v and roughness."""


@runtime_checkable
class RelightKernel(Protocol):
    """Optional function `relight` of a backend: `rendering.importance_sampling.relight_surface` as one kernel.

    The plain-torch definition is there, as it needs BRDF and light of that room.
    """

    def __call__(
        self,
        bvh: Any,
        surface: SurfaceSamples,
        light: LightTables,
        gaussians: GlossyGaussians | None,
        R_env_obj: Float[Tensor, "3 3"],
        n_brdf: int,
        f0: float,
    ) -> Float[Tensor, "p 3"]:
        """Reflected linear radiance of the points; not differentiable.

        Args:
            bvh: Result of `Backend.build` of the same backend.
            surface: Points and samples.
            light: Light and its tables.
            gaussians: Radiance of occluders; black when None.
            R_env_obj: Rotation from the object frame to the env frame.
            n_brdf: Number of samples of the BRDF.
            f0: Reflectance at normal incidence, of points and Gaussians.
        """
        ...
