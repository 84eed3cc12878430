"""Report of a run: results, quality measures and a live relighting view in one self-contained HTML file."""

from tumble.report.figures import panorama, small_camera
from tumble.report.page import write_report

__all__ = [
    "panorama",
    "small_camera",
    "write_report",
]
