"""The demo's own object and lights, made by code alone: a small enamel coffee pot, a room and a sunset."""

from tumble.synthetic.demo_object.lights import LAMP, SUN, WINDOW, environment, other_environment
from tumble.synthetic.demo_object.pot import write_object

__all__ = ["LAMP", "SUN", "WINDOW", "environment", "other_environment", "write_object"]
