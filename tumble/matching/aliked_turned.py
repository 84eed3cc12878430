"""ALIKED and LightGlue, also for frames between which the object has turned far in the image plane.

LightGlue has learned from upright photographs and finds next to nothing beyond some 45 degrees in the image plane. One
frame is therefore tried at four quarter turns, with few keypoints and the first layers only, and matched at the best.
"""

import torch

from tumble.matching import _lightglue, aliked
from tumble.matching._lightglue import DescribedKeypoints
from tumble.scene import Match, View, empty_match

VERSION = 1
PARTS = ("aliked",)
TURNS = 4
"""Number of turns that are tried, of 90 degrees each."""
TRIED_KEYPOINTS = 192
"""Number of keypoints of each frame with which a turn is tried, those of highest score."""
MIN_EXPECTED = 8.0
"""Expected number of matches of these after the first layers, in the best turn, below which a pair is given up. Of 77
pairs of a bottle in a hand this spares 32, with 3 % of all right matches and 31 % of the wrong ones."""


def load(device: torch.device | str):
    """Matcher on a device, which keeps the keypoints of frames."""
    network = aliked.network(str(device))

    @torch.no_grad()
    def expected(of_i: aliked.Features, of_j: aliked.Features) -> float:
        i, j = (
            DescribedKeypoints(each.keypoints.at[:TRIED_KEYPOINTS], each.keypoints.descriptors[:TRIED_KEYPOINTS])
            for each in (of_i, of_j)
        )
        return _lightglue.expected_matches(_lightglue.first_assignment(i, j, network.glue))

    def match(view_i: View, view_j: View) -> Match:
        of_i, turned = network.features(view_i), [network.features(view_j, turns) for turns in range(TURNS)]
        if min(len(of_i), len(turned[0])) == 0:
            return empty_match(view_i.number, view_j.number)
        tried = [expected(of_i, of_j) for of_j in turned]
        if max(tried) < MIN_EXPECTED:
            return empty_match(view_i.number, view_j.number)
        return network.matched(of_i, turned[tried.index(max(tried))], view_i.number, view_j.number)

    return match
