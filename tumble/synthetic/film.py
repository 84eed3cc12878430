"""The film that a phone would take of a synthetic capture: wider than the capture's images, with motion blur, sensor
noise, drifting exposure and compression."""

import math
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float, UInt8

from tumble.io import files, video
from tumble.maths import SE3, interpolate, linear_from_srgb, to_srgb8
from tumble.scene import Camera

FILM_FILE, BOX_FILE = "film.mp4", "film.json"
"""The film, and the document with the object's box on its first frame and the focal length."""
FRAMES_FOLDER = "film"
"""Folder with the film's frames before noise and compression."""
WIDER = (2.0, 1.5)
"""Width and height of the film in relation to those of the capture's images, which are its centre."""
SHUTTER = 0.2
"""Time for which the shutter is open [frames]."""
SUBFRAMES = 4
"""Moments over which a frame is averaged while the shutter is open."""
EXPOSURE_DRIFT = 0.06
"""Amplitude of the logarithm of the exposure's drift."""
DRIFT_PERIOD = 70
"""Period of the exposure's drift [frames]."""
READ_NOISE, SHOT_NOISE = 0.002, 0.006
"""Standard deviations of the noise: in the dark, and of the part that grows with the root of the radiance, at
radiance 1."""
QUALITY = 23
"""Constant rate factor of the compression."""
BOX_MARGIN = 2
"""Width of the margin around the object in the box on the first frame [pixels]."""


def film_camera(camera: Camera) -> Camera:
    """The film's camera: that of the capture with a larger image around the same centre."""
    width, height = (2 * round(n * factor / 2) for n, factor in zip((camera.width, camera.height), WIDER, strict=True))
    focal = float(camera.fx_fy_cx_cy[0])
    return Camera.from_fov(2 * math.atan(width / 2 / focal), height, width)


def shutter_times(time: float) -> list[float]:
    """Moments while the shutter is open for the frame of a time [frames], which is their mean."""
    return [time + SHUTTER * ((i + 0.5) / SUBFRAMES - 0.5) for i in range(SUBFRAMES)]


def pose_at(T_cam_obj: SE3, time: float) -> SE3:
    """Pose at a time [frames], interpolated between frames and extrapolated beyond the first and the last one."""
    last = len(T_cam_obj.xyz) - 1
    before = min(max(math.floor(time), 0), max(last - 1, 0))
    return interpolate(T_cam_obj[before], T_cam_obj[min(before + 1, last)], time - before)


def write_film(out: Path, names: list[str], mask: UInt8[np.ndarray, "h w"], camera: Camera, seed: int) -> None:
    """Write the film and its document from the frames in `FRAMES_FOLDER`.

    Args:
        out: Capture folder.
        names: File names of the frames.
        mask: The visible object on the first frame, 255, over 0.
        camera: The film's camera.
        seed: Seed of noise and drift.
    """
    frames = (files.read_image(out / FRAMES_FOLDER / name) for name in names)
    video.write_clip(out / FILM_FILE, _developed(frames, seed), quality=QUALITY)
    document: dict[str, Any] = {"focal": float(camera.fx_fy_cx_cy[0]), "frame": 0, "box": _box(mask)}
    files.write_json(out / BOX_FILE, document)


def _developed(frames: Iterator[UInt8[np.ndarray, "h w 3"]], seed: int) -> Iterator[UInt8[np.ndarray, "h w 3"]]:
    """Frames with drifting exposure and sensor noise."""
    rng = np.random.default_rng(seed)
    phase = rng.uniform(0, 2 * math.pi)
    for number, values in enumerate(frames):
        gain = math.exp(EXPOSURE_DRIFT * (math.sin(2 * math.pi * number / DRIFT_PERIOD + phase) - math.sin(phase)))
        radiance = gain * linear_from_srgb(torch.tensor(values) / 255).numpy()
        noise = READ_NOISE + SHOT_NOISE * np.sqrt(radiance)
        noisy: Float[np.ndarray, "h w 3"] = radiance + noise * rng.standard_normal(radiance.shape)
        yield to_srgb8(torch.from_numpy(noisy.clip(0, 1).astype(np.float32))).numpy()


def _box(mask: UInt8[np.ndarray, "h w"]) -> list[int] | None:
    """Left, top, width and height of a box around the object [pixels]; None if it is hidden."""
    rows, columns = np.nonzero(mask)
    if not len(rows):
        return None
    low = np.maximum([columns.min() - BOX_MARGIN, rows.min() - BOX_MARGIN], 0)
    high = np.minimum([columns.max() + BOX_MARGIN, rows.max() + BOX_MARGIN], np.array(mask.shape)[::-1] - 1)
    return [*low.tolist(), *(high - low + 1).tolist()]
