"""Gaussians as PLY: the common layout of 3D Gaussian splatting, and the same with our material as further columns."""

import math
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float

from tumble.io import files
from tumble.maths import srgb_from_linear
from tumble.rendering import relight
from tumble.scene import Asset, opacity

SH_DC, SH_REST = 0.28209479177387814, 45
"""Harmonic of degree 0, and how many further coefficients the common layout has."""


def write_ply(path: Path, columns: dict[str, Float[np.ndarray, " n"]]) -> None:
    """One row of 32-bit floats per Gaussian, binary, little endian."""
    table = np.stack([np.asarray(values, "<f4") for values in columns.values()], 1)
    names = "".join(f"property float {name}\n" for name in columns)
    head = f"ply\nformat binary_little_endian 1.0\nelement vertex {len(table)}\n{names}end_header\n"
    files.write_whole(path, lambda partial: partial.write_bytes(head.encode() + table.tobytes()))


@torch.no_grad()
def splats(asset: Asset, metres: float) -> dict[str, Float[np.ndarray, " n"]]:
    """The common layout of 3D Gaussian splatting: what splat viewers, which know no light, show.

    Colour is that of the first frame, sRGB, the same from all sides; the layout's harmonics beyond are zero.
    """
    gaussians = asset.gaussians
    alpha = opacity(gaussians.sdf, asset.gamma).clamp(1e-4, 1 - 1e-4)
    colour = (srgb_from_linear(relight.gaussian_colours(asset)).clamp(0, 1) - 0.5) / SH_DC
    quats = torch.nn.functional.normalize(gaussians.quats, dim=-1)
    groups = {
        ("x", "y", "z"): gaussians.means * metres,
        ("nx", "ny", "nz"): gaussians.normals,
        ("f_dc_0", "f_dc_1", "f_dc_2"): colour,
        tuple(f"f_rest_{i}" for i in range(SH_REST)): colour.new_zeros(len(colour), SH_REST),
        ("opacity",): torch.logit(alpha)[:, None],
        ("scale_0", "scale_1", "scale_2"): gaussians.log_scales + math.log(metres),
        ("rot_0", "rot_1", "rot_2", "rot_3"): quats,
    }
    return {name: values[:, i].cpu().numpy() for key, values in groups.items() for i, name in enumerate(key)}


@torch.no_grad()
def material_columns(asset: Asset) -> dict[str, Float[np.ndarray, " n"]]:
    """Linear albedo, perceptual roughness and reflectance at normal incidence, mean over the corners."""
    material = asset.material
    assert material is not None, "an asset with material"
    albedo = material.albedo.mean(1)
    columns = {f"albedo_{i}": albedo[:, i] for i in range(3)}
    columns |= {"roughness": material.roughness.mean(1), "f0": material.f0.expand(len(albedo))}
    return {name: values.cpu().numpy() for name, values in columns.items()}
