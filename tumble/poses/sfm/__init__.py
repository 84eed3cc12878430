"""Structure from motion of a rotating object in front of a static camera.

Relative poses of pairs of frames, rotation averaging, bundle adjustment of feature tracks and frontier points of
silhouettes, loop closure and relocalization; `stage` runs them in order. An object that hands hide in part is posed by
`segments` instead, from parts of the capture that are certain.
"""

from tumble.poses.sfm import stage
from tumble.poses.sfm.stage import Config, assess, gather, to_match

__all__ = ["Config", "gather", "assess", "stage", "to_match"]
