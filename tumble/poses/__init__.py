"""Stage 1: estimation of the object's poses from images and masks alone.

Two independent methods give the same kind of result, a `PoseResult`: `sfm` estimates all poses at once from matches
and silhouettes (structure from motion); `progressive` tracks the object frame by frame with a neural field, as in the
paper. `mask_refinement` trims masks to the shape that the poses give, for another round.
"""

from tumble.poses import mask_refinement, progressive, sfm
from tumble.poses.frame_pairs import neighbours
from tumble.poses.result import PoseQuality, PoseResult

__all__ = ["PoseQuality", "PoseResult", "mask_refinement", "neighbours", "progressive", "sfm"]
