"""Small films whose masks, motion and drift are known: the bundled clip's frames over a still background."""

from dataclasses import dataclass
from functools import cache
from pathlib import Path

import cv2
import numpy as np

from tumble.demo import bundled_folder
from tumble.io import files, video

HEIGHT, WIDTH, SIDE = 130, 160, 96


@dataclass(frozen=True)
class Scene:
    pictures: np.ndarray
    """[t h w 3] u8."""
    object: np.ndarray
    """Visible object, [t h w] bool."""
    hand: np.ndarray
    """[t h w] bool."""
    background: np.ndarray
    """[h w 3] u8."""

    def box(self, i: int = 0) -> tuple[int, int, int, int]:
        """A little wider than the object on a frame."""
        rows, columns = np.nonzero(self.object[i])
        left, top = int(columns.min()) - 3, int(rows.min()) - 3
        return left, top, int(columns.max()) + 4 - left, int(rows.max()) + 4 - top


@cache
def scene(n: int = 20, *, hand: bool = False, tint: float = 0.0, still: bool = False) -> Scene:
    """The demo object, drifting a few pixels, before a cloudy wall.

    Args:
        hand: A plain skin-coloured hand that sways in front of the lower part.
        tint: Amplitude of a drift of the red gain, a sine over the film.
        still: The object does not turn.
    """
    rng = np.random.default_rng(0)
    wall = (120 + sum(a * _cloud(rng, s) for s, a in ((20, 25), (6, 15), (2, 8)))).clip(10, 245)
    clip, masks = _demo(n)
    pictures, objects, hands = [], [], []
    for i in range(n):
        k = 0 if still else i
        top, left = 8 + round(4 * np.cos(i / 4)), 32 + round(6 * np.sin(i / 5))
        picture, coverage = wall.copy(), np.zeros((HEIGHT, WIDTH))
        coverage[top : top + SIDE, left : left + SIDE] = masks[k]
        where = slice(top, top + SIDE), slice(left, left + SIDE)
        picture[where] += masks[k][..., None] * (clip[k] - picture[where])
        held = np.zeros((HEIGHT, WIDTH), np.uint8)
        if hand:
            for finger in range(3):
                root = (60 + 18 * finger + round(5 * np.sin(i / 3)), 98 + round(4 * np.sin(i / 4 + finger)))
                cv2.ellipse(held, root, (7, 22), 8.0 * finger - 8, 0, 360, 255, -1)
            cv2.ellipse(held, (80 + round(5 * np.sin(i / 3)), 128), (42, 22), 0, 0, 360, 255, -1)
            picture[held > 0] = np.array([205, 150, 120]) * (0.85 + 0.1 * np.sin(np.nonzero(held)[1] / 30))[:, None]
        gain = np.array([1 + tint * np.sin(2 * np.pi * i / n), 1, 1])
        picture = 255 * ((picture / 255) ** 2.2 * gain).clip(0, 1) ** (1 / 2.2) + rng.normal(0, 1.5, picture.shape)
        pictures.append(picture.clip(0, 255).round().astype(np.uint8))
        objects.append((coverage > 0.5) & (held == 0))
        hands.append(held > 0)
    return Scene(np.stack(pictures), np.stack(objects), np.stack(hands), wall.astype(np.uint8))


def written(pictures: np.ndarray, path: Path) -> Path:
    video.write_clip(path, iter(pictures), quality=8)
    return path


def _cloud(rng: np.random.Generator, sigma: float) -> np.ndarray:
    noise = cv2.GaussianBlur(rng.standard_normal((HEIGHT, WIDTH, 3)), (0, 0), sigma)
    return noise / noise.std()


@cache
def _demo(n: int) -> tuple[np.ndarray, np.ndarray]:
    """The first frames of the bundled clip and their coverage in [0, 1], made smaller."""
    clip = [frame for frame, _ in zip(video.read_clip(bundled_folder() / "clip.mp4"), range(n), strict=False)]
    masks = [files.read_image(bundled_folder() / "masks" / f"{i:04d}.png")[..., 0] / 255.0 for i in range(n)]
    small = [cv2.resize(f.astype(np.float64), (SIDE, SIDE), interpolation=cv2.INTER_AREA) for f in clip]
    shares = [cv2.resize(m, (SIDE, SIDE), interpolation=cv2.INTER_AREA) for m in masks]
    # The clip is over black: its border pixels are darkened by their coverage already.
    return np.stack(small), np.stack([np.where(m > 0.9, 1.0, np.where(m > 0.5, m, 0.0)) for m in shares])
