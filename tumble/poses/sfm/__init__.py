"""Structure from motion of a rotating object in front of a static camera.

Relative poses of pairs of frames, rotation averaging, bundle adjustment of feature tracks and frontier points of
silhouettes, loop closure and relocalization; `stage` runs them in order.
"""

from tumble.poses.sfm import stage
from tumble.poses.sfm.stage import Config, assess, gather

__all__ = ["Config", "gather", "assess", "stage"]
