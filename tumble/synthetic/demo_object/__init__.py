"""Procedural object and environment maps of the demo: a small enamel coffee pot, a room and a sunset."""

from tumble.synthetic.demo_object.lights import LAMP, SUN, WINDOW, room_environment, sunset_environment
from tumble.synthetic.demo_object.pot import write_pot

__all__ = ["LAMP", "SUN", "WINDOW", "room_environment", "sunset_environment", "write_pot"]
