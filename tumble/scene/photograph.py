"""One frame of a capture as losses compare with it."""

from dataclasses import dataclass

from jaxtyping import Float
from torch import Tensor

from tumble.scene.capture import OBJECT, UNKNOWN, Capture


@dataclass(frozen=True)
class Frame:
    """One photograph as the losses want it."""

    image: Float[Tensor, "h w 3"]
    """sRGB in [0, 1]."""
    mask: Float[Tensor, "h w"]
    valid: Float[Tensor, "h w 1"]


def frame(capture: Capture, number: int, like: Tensor) -> Frame:
    """Photograph `number` of a capture in the dtype and on the device of `like`."""
    mask = capture.masks[number].to(like.device)
    image = capture.images[number].to(like) / 255
    return Frame(image, (mask == OBJECT).to(like), (mask != UNKNOWN).to(like)[..., None])
