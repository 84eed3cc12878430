"""Export for other programs: textured mesh (GLB), Gaussians (PLY), light, poses, and a confidence of the material."""

from tumble.export.asset import EXPORT_FILE, Preset, PresetName, extract_mesh, write_asset, write_textured_mesh
from tumble.export.confidence import N_LIGHTS, Confidence, confidence_of

__all__ = [
    "Confidence",
    "EXPORT_FILE",
    "N_LIGHTS",
    "Preset",
    "PresetName",
    "confidence_of",
    "extract_mesh",
    "write_asset",
    "write_textured_mesh",
]
