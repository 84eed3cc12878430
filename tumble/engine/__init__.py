"""How a stage is trained and kept: the one training loop, Adam over named leaves, run directories.

Knows stages, configurations and trees of tensors, and nothing of what they mean.
"""

from tumble.engine import loop, optim, run
from tumble.engine.loop import Progress, Stage, State, drive

__all__ = [
    "Progress",
    "Stage",
    "State",
    "drive",
    "loop",
    "optim",
    "run",
]
