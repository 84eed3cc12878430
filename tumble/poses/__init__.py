"""Stage 1: how the object moved, from frames and masks alone.

Two routes with one outcome: `sfm` finds all poses at once from matches and silhouettes, `progressive` follows the
object frame by frame with a neural field, as the paper does. They do not know each other.
"""

from tumble.poses import progressive, sfm
from tumble.poses.frame_pairs import neighbours
from tumble.poses.result import PoseQuality, PoseResult

__all__ = ["PoseQuality", "PoseResult", "neighbours", "progressive", "sfm"]
