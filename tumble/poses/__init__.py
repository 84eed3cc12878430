"""Stage 1: estimation of the object's poses from images and masks alone.

Two independent methods give the same kind of result, a `PoseResult`: `sfm` estimates all poses at once from matches
and silhouettes (structure from motion); `progressive` tracks the object frame by frame with a neural field, as in the
paper.
"""

from tumble.poses import progressive, sfm
from tumble.poses.frame_pairs import neighbours
from tumble.poses.result import PoseQuality, PoseResult

__all__ = ["PoseQuality", "PoseResult", "neighbours", "progressive", "sfm"]
