"""Structure from motion of a rotating object in front of a static camera.

Relative poses of pairs of frames, rotation averaging, bundle adjustment of feature tracks and frontier points of
silhouettes, and relocalization; before them, the motion of a turntable (`circular_motion`).
`schedule` has the order of the steps, `stage` carries them out. An object that hands hide in part is posed by
`segments` instead, from parts of the capture that are certain. `symmetry` has what concerns symmetric objects.
"""

from tumble.poses.sfm import stage
from tumble.poses.sfm.observations import without_doubt
from tumble.poses.sfm.stage import Config, assess, gather, is_hidden, shown

__all__ = ["Config", "assess", "gather", "is_hidden", "shown", "stage", "without_doubt"]
