"""Scores of the exported GLB, rendered by the renderer and with the protocol of the ground truth (extra `synth`)."""

from pathlib import Path
from typing import Annotated, Any, TypedDict

import msgspec
import torch

from tumble.evaluation import CaptureWithTruth, Prediction, Report, metrics, score_prediction
from tumble.export import EXPORT_FILE
from tumble.io import BadFile, files, progress
from tumble.maths import to_srgb8
from tumble.scene import Asset
from tumble.synthetic import glb_images, glb_maps, read_glb

SAMPLES = 64
"""Samples per pixel of relit images."""
MAX_STRETCH = 1e-3
"""Maximum difference of the focal lengths in x and y [pixels]."""


class _ExportFacts(TypedDict):
    """What the scores need of `export.json`."""

    metres_per_object_radius: Annotated[float, msgspec.Meta(gt=0)]


def export_scale(glb: Path) -> float:
    """Object radius in the unit of a GLB of `tumble export`.

    Raises:
        BadFile: The GLB or the `export.json` beside it is missing, or the latter is broken.
    """
    facts, fix = glb.parent / EXPORT_FILE, "give asset.glb where `tumble export` wrote it, beside its export.json"
    for path in (glb, facts):
        if not path.is_file():
            raise BadFile(path, "is missing", fix)
    return files.read_json(facts, _ExportFacts, fix)["metres_per_object_radius"]


@torch.no_grad()
def score_glb(glb: Path, asset: Asset, known: CaptureWithTruth, aligned: tuple[Any, str], out: Path) -> Report:
    """Score a GLB of `tumble export` in a capture's evaluation views, and write prediction and scores into `out`.

    Normals are those of the mesh without its normal map.

    Args:
        glb: The file, beside its `export.json`.
        asset: The asset that was exported.
        aligned: Result of `align_views`.

    Raises:
        BadFile: The file or its `export.json` is missing or broken, or the capture has no evaluation views or
            pixels that are not square.
        ModuleNotFoundError: The extra `synth` is not installed.
    """
    (alignment, words), truth, camera = aligned, known.truth, known.capture.camera
    if alignment is None or truth.trajectory is None or truth.albedo is None:
        raise BadFile(known.path, "has no evaluation views in which a GLB could be scored")
    fx, fy = camera.fx_fy_cx_cy[:2].tolist()
    if abs(fx - fy) > MAX_STRETCH:
        raise BadFile(
            known.path, "has pixels that are not square", "leave out --glb: Mitsuba's camera has square pixels"
        )
    model = read_glb(glb, export_scale(glb))
    poses = alignment.to_prediction(truth.trajectory).T_cam_obj
    views = [poses[i] for i in range(len(truth))]
    with progress.task("maps of the GLB"):
        maps = glb_maps(model, views, camera)
    R_true_pred = alignment.R_true_pred
    albedo = torch.from_numpy(maps.albedo)
    scale = metrics.albedo_scale(albedo, truth.albedo, truth.foreground)
    relit = {}
    for name, light in progress.track(truth.lights.items(), "path tracing the GLB", len(truth.lights)):
        turned = light.rotated(R_true_pred.inverse().matrix())
        options = {"albedo_scale": scale.numpy(), "f0": float(asset.material.f0), "samples": SAMPLES}
        relit[name] = to_srgb8(torch.from_numpy(glb_images(model, views, camera, turned, **options)))
    prediction = Prediction(
        albedo=albedo,
        normals=R_true_pred @ torch.from_numpy(maps.normal),
        roughness=torch.from_numpy(maps.roughness[..., 0]),
        metalness=None if truth.metalness is None else torch.from_numpy(maps.metalness[..., 0]),
        masks=torch.from_numpy(maps.mask),
        relit=relit,
    )
    return score_prediction(prediction, known, out, [words])
