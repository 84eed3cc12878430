"""Structure from motion of a turning object: relative poses, averaging, bundle adjustment, loop closure."""

from tumble.poses.sfm import stage
from tumble.poses.sfm.stage import Config, assess, gather

__all__ = ["Config", "gather", "assess", "stage"]
