"""The paper's stage 1 (section 4.1): a virtual camera, a neural signed distance field, and a frame at a time."""

from tumble.poses.progressive import stage
from tumble.poses.progressive.sdf_field import Sizes
from tumble.poses.progressive.stage import Config, gather
from tumble.poses.progressive.tracker import Rates, Weights

__all__ = ["Config", "Rates", "Sizes", "Weights", "gather", "stage"]
