"""The page of a run: what was found, how far to trust it, and a live view; one HTML file that loads nothing."""

from tumble.report.figures import panorama, small_camera
from tumble.report.page import write_report

__all__ = [
    "panorama",
    "small_camera",
    "write_report",
]
