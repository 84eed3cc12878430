"""Matchers: pixel correspondences between two frames. Drop a file with `VERSION` and `load(device) -> Matcher` here.

A matcher takes two views and returns pairs of pixels that show the same surface point. Both pixels lie on the object,
away from the border of the mask and from unknown pixels; a view without such pixels gives an empty match. VERSION is
raised when the same views give another result. A matcher that combines others lists their names in PARTS. One that sets
CONCURRENT is called by several threads at once.
"""

import functools
import hashlib
import json
import math
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

import cv2
import torch

from tumble.io import BadFile, in_threads, load_plugin, progress, read_tensors, write_tensors
from tumble.matching import _window
from tumble.scene import Capture, Match, View

__all__ = ["Matcher", "joined", "match_pairs", "settings", "views_of"]

Matcher = Callable[[View, View], Match]
"""Function that matches two views."""


def views_of(capture: Capture) -> list[View]:
    """All frames of a capture, as inputs of matchers."""
    return [View(i, image, mask) for i, (image, mask) in enumerate(zip(capture.images, capture.masks, strict=True))]


def joined(matches: Sequence[Match]) -> Match:
    """The correspondences of several matches of the same two frames."""
    uv_i, uv_j, confidence = (torch.cat([getattr(m, name) for m in matches]) for name in ("uv_i", "uv_j", "confidence"))
    return Match(matches[0].i, matches[0].j, uv_i, uv_j, confidence)


def match_pairs(
    views: Sequence[View],
    pairs: Sequence[tuple[int, int]],
    matcher: str,
    *,
    device: torch.device | str = "cpu",
    cache: Path | None = None,
) -> list[Match]:
    """Matches of pairs of views, in the order of the pairs.

    Args:
        views: Frames.
        pairs: Indices into `views`.
        matcher: Name of the matcher: its file name in this folder.
        device: Device of a matcher's network.
        cache: Folder with one file per pair. Cached pairs are not computed again, so that an interrupted run can be
            resumed; other frames, masks or settings have other file names.

    Raises:
        ValueError: There is no such matcher.
        BadFile: A file of the cache is damaged.
    """
    # Loaded at the first pair that is not cached: a network takes seconds to load, and may have been removed.
    load = functools.cache(load_plugin("matching", matcher).load)
    key = settings(matcher)
    digests = [_window.digest(view) for view in views]

    def match(number: int) -> tuple[int, Match]:
        i, j = pairs[number]
        path = _cache_path(cache, matcher, key, digests[i], digests[j])
        if path is not None and path.exists():
            return number, _read(path, views[i].number, views[j].number)
        found = load(device)(views[i], views[j])
        if path is not None:
            _write(path, found)
        return number, found

    n_threads = torch.get_num_threads() if getattr(load_plugin("matching", matcher), "CONCURRENT", False) else 1
    # Threads work on pairs far apart in the list, so that no two of them compute features of the same view.
    share = max(1, math.ceil(len(pairs) / n_threads))
    order = sorted(range(len(pairs)), key=lambda number: (number % share, number))
    with _one_thread_in_opencv():
        found = dict(progress.track(in_threads(match, order, n_threads), f"matching ({matcher})", len(pairs)))
    return [found[number] for number in range(len(pairs))]


@contextmanager
def _one_thread_in_opencv() -> Iterator[None]:
    """Context in which OpenCV's functions use one thread: the result of some depends on the number of threads."""
    before = cv2.getNumThreads()
    cv2.setNumThreads(1)
    try:
        yield
    finally:
        cv2.setNumThreads(before)


def settings(matcher: str) -> str:
    """Everything besides the views that determines a matcher's result, as JSON."""
    return json.dumps(_settings(matcher), sort_keys=True)


def _settings(matcher: str) -> dict[str, object]:
    """Constants of a matcher's file, of its windows, and of the matchers it combines."""
    module = load_plugin("matching", matcher)
    settings: dict[str, object] = {
        f"{source.__name__}.{name}": value
        for source in (module, _window)
        for name, value in vars(source).items()
        if name.isupper() and isinstance(value, int | float | str)
    }
    for part in getattr(module, "PARTS", ()):
        settings[part] = _settings(part)
    return settings


def _cache_path(cache: Path | None, matcher: str, settings: str, *digests: str) -> Path | None:
    """File of a pair of views in the cache, named by a hash of all that determines its match."""
    if cache is None:
        return None
    key = hashlib.blake2b(" ".join([matcher, settings, *digests]).encode(), digest_size=16).hexdigest()
    return cache / f"{matcher}-{key}.safetensors"


def _write(path: Path, match: Match) -> None:
    """Write a match without the frames' indices, which depend on the rest of the capture."""
    write_tensors(path, {name: getattr(match, name) for name in ("uv_i", "uv_j", "confidence")}, {"type": "Match"})


def _read(path: Path, i: int, j: int) -> Match:
    """Match of a file in the cache, between frames `i` and `j`."""
    fix = "delete it, it is computed again"
    tensors, header = read_tensors(path, fix)
    if header.get("type") != "Match":
        raise BadFile(path, "is not a match", fix)
    try:
        return Match(i, j, tensors["uv_i"], tensors["uv_j"], tensors["confidence"])
    except (KeyError, AssertionError, TypeError) as error:
        raise BadFile(path, f"is not a match: {error}", fix) from None
