"""Stage 1: estimation of the object's poses from images and masks alone.

Two independent methods give the same kind of result, a `PoseResult`: `sfm` estimates all poses at once from matches
and silhouettes (structure from motion); `progressive` tracks the object frame by frame with a neural field, as in the
paper. `mask_refinement` trims masks to the shape that the poses give, for another round; `background_removal` removes
from the masks what differs from the object as other frames show it. Where a hand hides a part of the object, all of
this works on images of a certain size (`working_size`).
"""

from tumble.poses import background_removal, mask_refinement, progressive, sfm, working_size
from tumble.poses.frame_pairs import neighbours
from tumble.poses.result import PoseQuality, PoseResult

__all__ = [
    "PoseQuality",
    "PoseResult",
    "background_removal",
    "mask_refinement",
    "neighbours",
    "progressive",
    "sfm",
    "working_size",
]
