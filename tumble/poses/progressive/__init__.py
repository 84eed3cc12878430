"""The paper's stage 1 (section 4.1): frame-by-frame tracking with a virtual camera and a neural signed distance field.

An alternative to `poses.sfm`, which the default recipe uses; `recipes.progressive_poses` selects this one.
"""

from tumble.poses.progressive import stage
from tumble.poses.progressive.registration import Motion
from tumble.poses.progressive.sdf_field import Sizes
from tumble.poses.progressive.stage import Config, gather
from tumble.poses.progressive.tracker import Rates, Weights

__all__ = ["Config", "Motion", "Rates", "Sizes", "Weights", "gather", "stage"]
