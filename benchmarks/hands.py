"""How many frames of videos show a hand to the detector and to the tracker, and the time per frame on one core.

`python -m benchmarks.hands VIDEO... [--draw FOLDER]` prints a table (benchmarks/hands.md). Whether the hands are in the
right place is for the eye: `--draw` writes a contact sheet per video with landmarks, seeds and region of twelve frames.
"""

import argparse
import time
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import torch

from tumble.io import video
from tumble.preprocess.hands import Hand, detect_hands, hand_region, hand_strokes, track_hands

DRAWN = 12
"""Frames per contact sheet."""
DETECTED_EVERY = 10
"""Interval of the frames in which hands are detected without tracking."""


def fastest(work: Callable[[], list[list[Hand]]], repeats: int) -> tuple[list[list[Hand]], float]:
    """The result, and the shortest processor time of several calls [s], which other work hardly affects."""
    times, result = [], []
    for _ in range(repeats):
        start = time.process_time()
        result = work()
        times.append(time.process_time() - start)
    return result, min(times)


def drawn(image: np.ndarray, hands: list[Hand]) -> np.ndarray:
    """The image, darker outside the region of the hands, with strokes in blue and landmarks in red."""
    shape = image.shape[:2]
    image = np.where(hand_region(hands, shape)[..., None], image, image // 2)
    image[hand_strokes(hands, shape)] = 60, 60, 255
    for point in (point for hand in hands for point in hand.landmarks):
        cv2.circle(image, np.floor(point).astype(int).tolist(), 2, (255, 0, 0), -1)
    return image


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("videos", type=Path, nargs="+")
    parser.add_argument("--draw", type=Path, help="folder of the contact sheets")
    parser.add_argument("--repeats", type=int, default=2)
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    cv2.setNumThreads(1)
    print("| video | frames | upright [%] | turned [%] | tracked [%] | detection [ms] | tracking [ms] |")
    print("|---|---|---|---|---|---|---|")
    for path in arguments.videos:
        images = np.stack(list(video.read_clip(path)))
        some = images[::DETECTED_EVERY]
        upright = [detect_hands(image, turns=(0.0,), min_palm_score=0.5) for image in some]
        turned, detection = fastest(lambda some=some: [detect_hands(image) for image in some], arguments.repeats)
        tracked, tracking = fastest(lambda images=images: track_hands(images), arguments.repeats)
        shares = (f"{100 * np.mean([bool(hands) for hands in each]):.0f}" for each in (upright, turned, tracked))
        times = f"{1000 * detection / len(some):.1f} | {1000 * tracking / len(images):.1f}"
        print(f"| {path.stem} | {len(images)} | {' | '.join(shares)} | {times} |", flush=True)
        if arguments.draw:
            arguments.draw.mkdir(parents=True, exist_ok=True)
            chosen = np.linspace(0, len(images) - 1, DRAWN).astype(int)
            tiles = np.stack([drawn(images[i], tracked[i]) for i in chosen])
            sheet = np.concatenate([np.concatenate(list(row), 1) for row in tiles.reshape(-1, 3, *tiles.shape[1:])], 0)
            cv2.imwrite(str(arguments.draw / f"{path.stem}.png"), cv2.cvtColor(sheet, cv2.COLOR_RGB2BGR))


if __name__ == "__main__":
    main()
