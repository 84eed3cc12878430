"""A hand that holds the object in a synthetic capture: a rigged mesh, grasps by contact search, regrasps over the film,
and the forearm up to the border of the image."""

from tumble.synthetic.hand.arm import skin_tone
from tumble.synthetic.hand.motion import HandMotion, plan

__all__ = ["HandMotion", "plan", "skin_tone"]
