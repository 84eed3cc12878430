"""PLY files of Gaussians: the common layout of 3D Gaussian splatting, optionally with columns for the material."""

import math
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float

from tumble.io import files
from tumble.maths import srgb_from_linear
from tumble.rendering import relight
from tumble.scene import Asset, opacity

SH_DC = 0.28209479177387814
"""Spherical harmonic of degree 0."""
N_SH_REST = 45
"""Number of coefficients of degrees 1 to 3, three colour channels together, in the common layout."""


def write_ply(path: Path, columns: dict[str, Float[np.ndarray, " n"]]) -> None:
    """Write a binary PLY with one row of little-endian 32-bit floats per Gaussian."""
    table = np.stack([np.asarray(values, "<f4") for values in columns.values()], 1)
    names = "".join(f"property float {name}\n" for name in columns)
    head = f"ply\nformat binary_little_endian 1.0\nelement vertex {len(table)}\n{names}end_header\n"
    files.write_atomically(path, lambda partial: partial.write_bytes(head.encode() + table.tobytes()))


@torch.no_grad()
def splat_columns(asset: Asset, metres: float) -> dict[str, Float[np.ndarray, " n"]]:
    """Columns of the common layout of 3D Gaussian splatting, for splat viewers, which cannot relight.

    The colour is that of the first frame, sRGB, independent of the view; harmonics above degree 0 are zero.

    Args:
        metres: Object radius in the file's unit.
    """
    gaussians = asset.gaussians
    alpha = opacity(gaussians.sdf, asset.gamma).clamp(1e-4, 1 - 1e-4)
    colour = (srgb_from_linear(relight.gaussian_colours(asset)).clamp(0, 1) - 0.5) / SH_DC
    quats = torch.nn.functional.normalize(gaussians.quats, dim=-1)
    groups = {
        ("x", "y", "z"): gaussians.means * metres,
        ("nx", "ny", "nz"): gaussians.normals,
        ("f_dc_0", "f_dc_1", "f_dc_2"): colour,
        tuple(f"f_rest_{i}" for i in range(N_SH_REST)): colour.new_zeros(len(colour), N_SH_REST),
        ("opacity",): torch.logit(alpha)[:, None],
        ("scale_0", "scale_1", "scale_2"): gaussians.log_scales + math.log(metres),
        ("rot_0", "rot_1", "rot_2", "rot_3"): quats,
    }
    return {name: values[:, i].cpu().numpy() for key, values in groups.items() for i, name in enumerate(key)}


@torch.no_grad()
def material_columns(asset: Asset) -> dict[str, Float[np.ndarray, " n"]]:
    """Columns of the material: linear albedo, perceptual roughness and F0, means over a Gaussian's corners; metalness
    if there is metal."""
    material = asset.material
    assert material is not None, "the asset has no material"
    albedo = material.albedo.mean(1)
    columns = {f"albedo_{i}": albedo[:, i] for i in range(3)}
    columns |= {"roughness": material.roughness.mean(1), "f0": material.f0.expand(len(albedo))}
    columns |= {} if material.metalness is None else {"metalness": material.metalness}
    return {name: values.cpu().numpy() for name, values in columns.items()}
