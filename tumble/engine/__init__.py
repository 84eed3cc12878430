"""Training of stages: the training loop with checkpoints, Adam over named parameters, recorded steps, run directories.

It works on generic stages, configurations and trees of tensors.
"""

from tumble.engine import graph, loop, optim, run
from tumble.engine.loop import CACHE, Progress, Stage, State, drive

__all__ = [
    "CACHE",
    "Progress",
    "Stage",
    "State",
    "drive",
    "graph",
    "loop",
    "optim",
    "run",
]
