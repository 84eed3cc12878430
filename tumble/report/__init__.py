"""Report of a run: results, quality measures and a live relighting view in one self-contained HTML file."""

from tumble.report import preset_lights
from tumble.report.figures import panorama, small_camera, webp_file
from tumble.report.page import capture_of_run, script_hash, style_sheet, write_report

__all__ = [
    "capture_of_run",
    "panorama",
    "preset_lights",
    "script_hash",
    "small_camera",
    "style_sheet",
    "webp_file",
    "write_report",
]
