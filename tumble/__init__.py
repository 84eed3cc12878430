"""tumble: object motion, shape, material and light from one video of an object turned in the hand."""

__version__ = "0.1.0"
