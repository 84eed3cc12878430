"""An asset for other programs: textured mesh as GLB, Gaussians as PLY, light, poses; and how sure its material is."""

from tumble.export.asset import Preset, PresetName, extract_mesh, write_asset, write_textured_mesh
from tumble.export.confidence import LAMPS, Confidence, confidence_of

__all__ = [
    "Confidence",
    "LAMPS",
    "Preset",
    "PresetName",
    "confidence_of",
    "extract_mesh",
    "write_asset",
    "write_textured_mesh",
]
