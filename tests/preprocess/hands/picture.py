"""A photograph of a right hand that comes from the right and holds a tumbler, with positions read off by eye."""

from pathlib import Path

import numpy as np
from PIL import Image

THUMB_TIP, WRIST_SIDE, LITTLE_FINGER = (224, 105), (315, 128), (249, 137)
"""[pixels]"""


def picture() -> np.ndarray:
    return np.asarray(Image.open(Path(__file__).with_name("hand.jpg")).convert("RGB"))
