"""Marks of the user in the browser: a box around the object, and clicks that correct its masks.

A local server sends one page (`pick.html`) and cuts the masks again for each click; the choice becomes options.
"""

from tumble.preprocess.picker.box_picker import pick_box

__all__ = ["pick_box"]
