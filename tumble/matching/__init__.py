"""Drop a matcher here: a file with `VERSION` and `load(device) -> Matcher`.

A matcher takes two views and finds pixels that show the same surface point. Both ends of every correspondence lie on
pixels that are surely object, away from the border of the mask; a view without such pixels has no match. VERSION is
raised when the same views give another result. A matcher made of others names them in PARTS.
"""

import functools
import hashlib
import json
from collections.abc import Callable, Sequence
from pathlib import Path

import safetensors
import safetensors.torch
import torch
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

from tumble.io import BadFile, files, named
from tumble.matching import _window
from tumble.scene import Capture, Match, View

__all__ = ["Matcher", "match_pairs", "settings", "views_of"]

Matcher = Callable[[View, View], Match]


def views_of(capture: Capture) -> list[View]:
    """Every frame of a capture, as matchers take them."""
    return [View(i, image, mask) for i, (image, mask) in enumerate(zip(capture.images, capture.masks, strict=True))]


def match_pairs(
    views: Sequence[View],
    pairs: Sequence[tuple[int, int]],
    matcher: str,
    *,
    device: torch.device | str = "cpu",
    cache: Path | None = None,
) -> list[Match]:
    """The matches of pairs of views, in the order of the pairs; a bar shows how far it is.

    Args:
        views: The frames.
        pairs: Indices into `views`.
        matcher: File name in this folder.
        device: Where a matcher with a network runs it.
        cache: Folder with one file per pair. What is in it is not computed again, so an interrupted run goes on where
            it stopped; other frames, masks or settings make other files.

    Raises:
        BadFile: A file of the cache is damaged.
    """
    # Loaded at the first pair that is not in the cache: a network takes seconds, and may be gone by now.
    load = functools.cache(named("matching", matcher).load)
    decides = settings(matcher)
    names = [_window.digest(view) for view in views]
    found = []
    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn())
    with Progress(*columns, console=Console(stderr=True), transient=True) as bar:
        for i, j in bar.track(pairs, description=f"matching ({matcher})"):
            path = _place(cache, matcher, decides, names[i], names[j])
            if path is not None and path.exists():
                found.append(_read(path, views[i].number, views[j].number))
                continue
            found.append(load(device)(views[i], views[j]))
            if path is not None:
                _write(path, found[-1])
    return found


def settings(matcher: str) -> str:
    """All that decides a matcher's result besides the views, as JSON."""
    return json.dumps(_settings(matcher), sort_keys=True)


def _settings(matcher: str) -> dict[str, object]:
    """The constants of a matcher's file, and of those it is made of."""
    module = named("matching", matcher)
    settings: dict[str, object] = {
        f"{source.__name__}.{name}": value
        for source in (module, _window)
        for name, value in vars(source).items()
        if name.isupper() and isinstance(value, int | float | str)
    }
    for part in getattr(module, "PARTS", ()):
        settings[part] = _settings(part)
    return settings


def _place(cache: Path | None, matcher: str, settings: str, *names: str) -> Path | None:
    if cache is None:
        return None
    key = hashlib.blake2b(" ".join([matcher, settings, *names]).encode(), digest_size=16).hexdigest()
    return cache / f"{matcher}-{key}.safetensors"


def _write(path: Path, match: Match) -> None:
    """The correspondences without the frames' numbers: those depend on what else is in the capture."""
    tensors = {name: getattr(match, name).contiguous() for name in ("uv_i", "uv_j", "confidence")}
    files.write_whole(path, lambda partial: safetensors.torch.save_file(tensors, partial))


def _read(path: Path, i: int, j: int) -> Match:
    try:
        tensors = safetensors.torch.load_file(path)
        return Match(i, j, tensors["uv_i"], tensors["uv_j"], tensors["confidence"])
    except (safetensors.SafetensorError, KeyError) as error:
        raise BadFile(path, f"is no match: {error}", "delete it, it is computed again") from None
