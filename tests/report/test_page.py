"""The report is self-contained, its health card reports known defects, and its live view works in a browser offline."""

import base64
import dataclasses
import hashlib
import html
import json
import math
import re
import sys
from html.parser import HTMLParser
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch

from tests import devtools
from tests.export.test_bake import RADIUS, painted
from tests.surfaces import sphere
from tumble.export import asset as export
from tumble.export import confidence
from tumble.io.files import BadFile
from tumble.maths.images import linear_from_srgb, srgb_from_linear, to_srgb8
from tumble.maths.se3 import SE3
from tumble.poses.result import Observability, PoseQuality
from tumble.report import figures, health_card, preset_lights, svg, training_views, worst_frames
from tumble.report import page as report
from tumble.report.worst_frames import AllFrames
from tumble.scene.asset import Asset
from tumble.scene.camera import Camera
from tumble.scene.capture import BACKGROUND, OBJECT, UNKNOWN, Capture
from tumble.scene.environment import Environment
from tumble.scene.trajectory import Trajectory
from tumble.synthetic import trajectories

SMALL = export.Preset(triangles=800, texture=64, cells=24, views=12, pixels=64)
N, SIDE = 10, 40
RECORDS = [
    {"name": "refine", "event": "start"},
    {"name": "refine", "step": 1, "of": 200, "seconds": 1.0, "metrics": {"render": 0.5}},
    {"name": "refine", "step": 200, "of": 200, "seconds": 9.0, "metrics": {"render": 0.1}},
    {"name": "refine", "event": "done", "seconds": 9.375},
    {"name": "decompose", "event": "start"},
    {"name": "decompose", "event": "done", "seconds": 201.0},
]
RECIPE = {"refine": {"steps": 200, "weights": {"mask": 0.125}}, "decompose": {"bounce": "none"}, "seed": 7}
HOSTILE = """--><!--</script></style></title><script>alert(1)</script><img src=x onerror=alert(2)>"' onload='alert(3)"""
RECORDS += [
    {"name": "decompose", "event": "colour", "factor": [1.0, 1.0, 1.0], "deviation": [0.25, 0.23, 0.21]},
    {"name": HOSTILE, "step": 1, "of": HOSTILE, "seconds": 0.0, "metrics": {"render": 1.0, HOSTILE: 1.0}},
    {"name": HOSTILE, "event": "done", "seconds": 0.0},
]
RECIPE |= {HOSTILE: {HOSTILE: HOSTILE, "list": [HOSTILE], "inner": {HOSTILE: HOSTILE}}, "text": HOSTILE}
FOCAL = float(Camera.from_fov(math.radians(30), SIDE, SIDE).fx_fy_cx_cy[0])
SUMMARY = report.RunSummary(f"a <mug> & more {HOSTILE}", RECORDS, RECIPE, FOCAL)


@pytest.fixture(scope="module")
def asset() -> Asset:
    """A painted sphere visible from all around, under light that is brighter on one side."""
    shape = painted(sphere(1500, radius=RADIUS))
    T = trajectories.handheld(N, trajectories.distance_for(math.radians(30)), seed=1)
    radiance = 0.4 + torch.linspace(0, 2, 16)[None, :, None].expand(8, 16, 3)
    return dataclasses.replace(
        shape,
        environment=Environment.from_radiance(radiance),
        trajectory=Trajectory(SE3(T.wxyz.float(), T.xyz.float()), "camera"),
        camera=Camera.from_fov(math.radians(30), SIDE, SIDE),
    )


@pytest.fixture(scope="module")
def capture(asset: Asset) -> Capture:
    """A capture whose photos are the asset's own renders."""
    scene = training_views.prepare(asset)
    images, masks = [], []
    for number in range(N):
        linear, view = training_views.render(scene, number, asset.camera)
        images.append(to_srgb8(linear))
        masks.append(torch.where(view.alpha >= 0.5, OBJECT, BACKGROUND).to(torch.uint8))
    names = tuple(f"{i:04}.png" for i in range(N))
    return Capture(torch.stack(images), torch.stack(masks), asset.camera, names, "camera", asset.trajectory)


@pytest.fixture(scope="module")
def page(asset: Asset, capture: Capture, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("report")
    export.write_textured_mesh(asset, export.extract_mesh(asset, SMALL), SMALL, folder / "asset.glb")
    masks = capture.masks.clone()
    masks[N - 1] = masks[N - 1].roll(SIDE // 4, 0)  # the health card names this frame
    names = tuple(f"{name} {HOSTILE}" for name in capture.names)
    run_capture = dataclasses.replace(capture, names=names, masks=masks)
    rows = report.build(asset, run_capture, lambda: folder / "asset.glb", SUMMARY, None, folder / "report.html")
    assert any(HOSTILE in row.sentence for row in rows)
    return folder / "report.html"


def embedded(page: Path, name: str) -> bytes:
    found = re.search(rf'<script type="text/plain" id="{name}">([^<]*)</script>', page.read_text("utf-8"))
    assert found is not None, name
    return base64.b64decode(found[1], validate=True)


def text(page: Path) -> str:
    """Visible text of the page, without markup."""
    body = re.sub(r"<(script|style|title)\b.*?</\1>", "", page.read_text("utf-8"), flags=re.S)
    return html.unescape(re.sub(r"<[^>]+>", " ", body))


def test_the_page_names_the_worst_frame_and_what_was_seen(page: Path) -> None:
    words = " ".join(text(page).split())
    assert f"0009.png {HOSTILE} mask and reconstruction overlap by" in words
    assert re.search(r"(All of the surface was seen|[Nn]o frame shows|Hardly any frame shows)", words)
    assert re.search(r"top \d+% \d+ bottom \d+% \d+", words)


def test_the_page_loads_nothing(page: Path) -> None:
    """Every address is a data URL or an anchor; the only web address is the name of an XML namespace."""
    source = page.read_text("utf-8")
    markup = re.sub(r"<script\b.*?</script>", "", source, flags=re.S)
    addresses = re.findall(r'(?:src|href)="([^"]*)"', markup)
    assert len(addresses) > 30
    assert all(a.startswith(("data:image/", "#")) or a == "data:," for a in addresses)
    assert not re.search(r"@import|url\(", markup)
    assert set(re.findall(r"https?://[\w./#-]+", source)) <= {"http://www.w3.org/1999/xhtml"}
    assert "default-src 'none'" in source
    assert "{{" not in markup


def test_an_assumed_focal_length_is_marked_as_such(page: Path, asset: Asset, capture: Capture) -> None:
    """Half the width over the tangent of half the field of view."""
    focal = f"{0.5 * SIDE / math.tan(math.radians(15)):.0f} pixels"
    assert f"{focal}, assumed" in text(page)
    assert report._facts(asset, capture, dataclasses.replace(SUMMARY, assumed_focal=None))["Focal length"] == focal
    better = report._facts(asset, capture, dataclasses.replace(SUMMARY, assumed_focal=60.0))
    assert better["Focal length"] == f"{focal} (estimated; 60 was assumed at the start)"


def test_every_embedded_part_decodes(page: Path, asset: Asset) -> None:
    assert embedded(page, "glb")[:4] == b"glTF"
    for name, light in {
        "recovered": asset.environment,
        "studio": preset_lights.studio(),
        "overcast": preset_lights.overcast(),
        "sunset": preset_lights.sunset(),
    }.items():
        data = embedded(page, name)
        assert data.startswith(b"#?RADIANCE")
        read = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED)[..., ::-1]
        # With a shared exponent the largest channel has eight bits.
        true = light.radiance.numpy()
        assert (np.abs(read - true) <= true.max(-1, keepdims=True) / 128).all()
    for data in re.findall(r'src="data:image/webp;base64,([^"]*)"', page.read_text("utf-8")):
        assert cv2.imdecode(np.frombuffer(base64.b64decode(data), np.uint8), cv2.IMREAD_UNCHANGED) is not None


def test_times_and_settings_are_those_of_the_log(page: Path) -> None:
    words = " ".join(text(page).split())
    assert "refine 200 9.4 s" in words
    assert "decompose - 3.4 min" in words
    assert "all 3.5 min" in words
    assert "weights.mask 0.125" in words
    assert 'bounce "none"' in words
    assert "seed 7" in words


def test_without_xatlas_there_is_a_page_without_a_mesh(
    asset: Asset, capture: Capture, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "xatlas", None)
    with pytest.warns(UserWarning, match="xatlas.*the report has no live view"):
        assert report.write_model(asset, tmp_path, capture) is None


def test_a_name_is_escaped(page: Path) -> None:
    assert "a <mug> & more" in text(page)
    assert "<mug>" not in page.read_text("utf-8")


class Elements(HTMLParser):
    """All elements of a page, the text of its scripts, and the attributes that a browser would execute."""

    def __init__(self) -> None:
        super().__init__()
        self.tags, self.attributes, self.scripts, self.handlers, self.data = [], [], [], [], []
        self.inside = ""

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.append(tag)
        self.attributes.append(attrs)
        self.inside = tag
        self.handlers += [name for name, value in attrs if name.startswith("on") or "javascript:" in (value or "")]

    def handle_data(self, data: str) -> None:
        (self.scripts if self.inside == "script" else self.data).append(data)

    def handle_endtag(self, tag: str) -> None:
        self.inside = ""


def test_nothing_that_a_run_says_becomes_markup(page: Path) -> None:
    """Names of frames, capture, stages in the log and settings, values of settings, and advice of the health card."""
    elements = Elements()
    elements.feed(page.read_text("utf-8"))
    assert elements.handlers == []
    # Settings and four lights and the mesh of the live view as data, and two scripts of the package.
    assert elements.tags.count("script") == 8
    assert not any("alert" in script for script in elements.scripts)
    assert all(dict(attrs).get("src", "data:").startswith("data:") for attrs in elements.attributes)
    shown = "".join(elements.data)
    # In title, heading, photos, health card, timings, and as names of settings.
    assert shown.count(HOSTILE) >= 10
    assert '"--><!--</script></style></title><script>' in shown  # the value of a setting is shown as JSON


def test_the_scripts_of_the_page_are_those_of_the_package(page: Path) -> None:
    """Its content security policy allows no others, whatever else might get into the page."""
    policy = re.search(r'Content-Security-Policy" content="([^"]*)"', page.read_text("utf-8"))
    assert policy is not None
    source = html.unescape(policy[1])
    scripts = re.findall(r"<script>(.*?)</script>", page.read_text("utf-8"), flags=re.S)
    hashes = [base64.b64encode(hashlib.sha256(script.encode()).digest()).decode() for script in scripts]
    assert len(hashes) == 2
    # These would make a browser see another text than the one that was hashed.
    assert not any(sign in script for script in scripts for sign in ("<!--", "<script", "\r", "\0"))
    assert f"script-src 'sha256-{hashes[0]}' 'sha256-{hashes[1]}';" in source


def test_the_live_view_starts_at_the_pose_of_a_frame(page: Path, asset: Asset) -> None:
    """The quaternion, as a matrix, is the rotation from object to OpenGL camera axes of some frame."""
    found = re.search(r'id="about">(.*?)</script>', page.read_text("utf-8"))
    assert found is not None
    about = json.loads(found[1])
    assert about["fov"] == pytest.approx(30, abs=1e-4)
    x, y, z, w = about["object_to_camera"]
    R = torch.tensor(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
            [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
            [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
        ]
    )
    # Under light "camera" that rotation is R_env_obj.
    assert (asset.trajectory.R_env_obj - R).flatten(1).norm(dim=1).min() < 1e-5


def test_renders_equal_photos_that_are_renders(asset: Asset, capture: Capture) -> None:
    frames = list(training_views.frames(training_views.prepare(asset), capture))
    assert [frame.name for frame in frames] == list(capture.names)
    # Rounding to code values: a uniform error of at most half of 1 / 255, 10.8 dB below an error of 1 / 255.
    assert min(frame.psnr for frame in frames) > 55
    assert all(frame.iou == 1 for frame in frames)
    assert max(abs(frame.exposure_stops) for frame in frames) < 0.02
    rows = health_card.card(frames, None, confidence.confidence_of(asset, asset.camera))
    assert [row.rating for row in rows[:6]] == ["good", "good", "good", "none", "none", "none"]


def test_large_photos_are_averaged_in_linear_light(
    asset: Asset, capture: Capture, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Which keeps the mean: of black and white stripes it is half of white, not 0.21 of it."""
    monkeypatch.setattr(training_views, "MAX_SIDE", SIDE // 4)
    images = torch.zeros_like(capture.images)
    images[:, :, ::2] = 255
    frame = next(training_views.frames(training_views.prepare(asset), dataclasses.replace(capture, images=images)))
    assert max(frame.photo.shape[:2]) == SIDE // 4
    assert float(linear_from_srgb(frame.photo).mean()) == pytest.approx(0.5, abs=0.02)


def test_the_card_reports_drift_lost_frames_and_outliers(asset: Asset, capture: Capture) -> None:
    images = capture.images.clone()
    half = srgb_from_linear(0.5 * linear_from_srgb(images[: N // 2].float() / 255))
    images[: N // 2] = (255 * half).round().to(torch.uint8)
    masks = capture.masks.clone()
    masks[N - 1] = masks[N - 1].roll(SIDE // 4, 0)
    damaged = dataclasses.replace(capture, images=images, masks=masks)
    lost = torch.zeros(N, dtype=torch.bool)
    lost[3] = True
    ones = torch.ones(N)
    observability = Observability(torch.tensor([0.0, 1.0, 0.0]), torch.tensor([0.01, 0.01, 0.01]))
    quality = PoseQuality(4 * ones, 50 * ones, ones, ones, 0.01 * ones, lost, torch.tensor(3.0), observability)
    frames = list(training_views.frames(training_views.prepare(asset), damaged))
    photo, silhouette, exposure, turn, lost_frames, match, _, colour = health_card.card(
        frames, quality, confidence.confidence_of(asset, asset.camera), [0.2, 0.6, 0.1]
    )
    assert photo.marks[0] == "bad" or photo.rating != "good"
    # One frame's mask is shifted by a quarter of the image.
    assert silhouette.rating == "good"
    assert "0009.png" in silhouette.sentence
    assert silhouette.marks[-1] == "bad"
    # Half of the frames are one stop darker.
    assert exposure.rating == "bad"
    assert float(exposure.value.split()[0]) == pytest.approx(1.0, abs=0.05)
    assert "Lock exposure" in exposure.sentence
    corrected = health_card.card(frames, quality, confidence.confidence_of(asset, asset.camera), corrected=True)[2]
    assert (corrected.value, corrected.rating) == (exposure.value, exposure.rating)
    assert "shades the object" in corrected.sentence
    assert "Lock exposure" not in corrected.sentence
    assert (turn.value, turn.rating) == ("172 degrees", "good")
    assert (lost_frames.value, lost_frames.rating) == ("1 of 10", "warn")
    assert (match.value, match.rating) == ("4.00 px", "bad")
    assert (colour.value, colour.rating) == ("± 60%", "warn")
    assert health_card.overall([photo, silhouette, exposure, lost_frames, match])[0] == "bad"


@pytest.mark.parametrize(("count", "rating"), [(0, "good"), (1, "warn"), (4, "warn"), (5, "bad")])
def test_more_than_a_tenth_of_lost_frames_is_bad(count: int, rating: str) -> None:
    """Of 40 frames."""
    ones, observability = torch.ones(40), Observability(torch.tensor([0.0, 1.0, 0.0]), torch.full((3,), 0.01))
    lost = torch.arange(40) < count
    quality = PoseQuality(ones, 50 * ones, ones, ones, 0.01 * ones, lost, torch.tensor(3.0), observability)
    row = health_card._lost_row(quality)
    assert (row.value, row.rating) == (f"{count} of 40", rating)
    assert row.marks.count("bad") == count


@pytest.mark.parametrize(("few", "rating"), [(10, "good"), (40, "warn"), (70, "bad")])
def test_a_surface_that_is_lit_from_few_directions_is_named(few: int, rating: str) -> None:
    """Percent of the visible points; lights that are fixed to the object light them from at most six directions."""
    lights = torch.where(torch.arange(100) < few, 6.0, 7.0)
    # What no frame shows does not count.
    unseen = torch.zeros(300)
    found = confidence.Confidence(torch.cat([torch.ones(100), unseen]), torch.cat([lights, unseen]), torch.zeros(400))
    row = health_card._light_row(found)
    assert (row.value, row.rating) == (f"{few}% of the surface", rating)


@pytest.mark.parametrize(("degrees", "rating"), [(22, "bad"), (60, "warn"), (120, "good")])
def test_an_object_that_was_hardly_turned_is_named(asset: Asset, degrees: float, rating: str) -> None:
    ones, observability = torch.ones(N), Observability(torch.tensor([0.0, 1.0, 0.0]), torch.full((3,), 0.01))
    lost, turn = torch.zeros(N, dtype=torch.bool), torch.tensor(degrees).deg2rad()
    quality = PoseQuality(ones, 50 * ones, ones, ones, 0.01 * ones, lost, turn, observability)
    rows = health_card.card([], quality, confidence.confidence_of(asset, asset.camera))
    assert [row.rating for row in rows if row.name == "Turn of the object"] == [rating]


def test_the_spoilt_frames_are_shown(asset: Asset, capture: Capture) -> None:
    """One mask is shifted, after it lost a part that did not matter; another frame has no pose."""
    shifted, lost = 2, 6
    masks = capture.masks.clone()
    masks[shifted] = masks[shifted].roll(SIDE // 4, 0)
    before = masks.clone()
    before[shifted, :3, :3] = OBJECT
    kept = [i for i in range(N) if i != lost]
    part = dataclasses.replace(asset, trajectory=asset.trajectory.select(kept))
    after = dataclasses.replace(capture, masks=masks)
    rendered = list(training_views.frames(training_views.prepare(part), after.select(kept)))
    everything = AllFrames(dataclasses.replace(capture, masks=before), after)
    worst, other = worst_frames.worst_frames(everything, rendered)
    assert (other.name, worst.name) == (capture.names[lost], capture.names[shifted])
    assert other.reasons == ("no pose was found; the frame was left out",)
    assert [title for title, _ in other.pictures] == ["mask"]
    assert re.fullmatch(r"mask and reconstruction overlap by \d\d% only", worst.reasons[0])
    assert [title for title, _ in worst.pictures] == ["mask before", "mask after"]
    picture = worst.pictures[1][1]
    for colour in (worst_frames.MASK_COLOUR, worst_frames.SILHOUETTE_COLOUR):
        assert (picture == colour).all(-1).sum() > 50
    html = figures.worst_frames([dataclasses.replace(other, name=HOSTILE)])
    assert html.count("<img") == 1
    assert HOSTILE not in html
    assert "no pose was found" in html


def test_a_good_run_has_no_worst_frames(asset: Asset, capture: Capture) -> None:
    """But for the colours of a hand in one mask, and a mask of a third of its area."""
    rendered = list(training_views.frames(training_views.prepare(asset), capture))
    assert worst_frames.worst_frames(AllFrames(capture, capture), rendered) == []
    handed = AllFrames(capture, capture, {capture.names[1]: 0.2})
    assert [frame.reasons for frame in worst_frames.worst_frames(handed, rendered)] == [
        ("20% of the mask has the colours of the hand",)
    ]
    masks = capture.masks.clone()
    rows = torch.where((masks[5] == OBJECT).any(1))[0]
    masks[5, int(rows[len(rows) // 3]) :] = BACKGROUND
    small = dataclasses.replace(capture, masks=masks)
    (frame,) = worst_frames.worst_frames(AllFrames(small, small), rendered)
    assert frame.name == capture.names[5]
    assert re.fullmatch(r"0\.[23] times the area of the frames around it", frame.reasons[0])


def test_a_mask_that_stage_1_has_repaired_is_no_fault(asset: Asset, capture: Capture) -> None:
    """All of the image was object at first; the area that counts is that of the mask of the last round."""
    masks = capture.masks.clone()
    masks[5] = OBJECT
    rendered = list(training_views.frames(training_views.prepare(asset), capture))
    assert worst_frames.worst_frames(AllFrames(dataclasses.replace(capture, masks=masks), capture), rendered) == []


def test_a_hand_is_no_error_of_the_silhouettes(asset: Asset, capture: Capture) -> None:
    """It hides a part of the object, and is unknown in the masks."""
    masks = capture.masks.clone()
    masks[:, SIDE // 2 :] = UNKNOWN
    held = training_views.frames(training_views.prepare(asset), dataclasses.replace(capture, masks=masks))
    assert min(frame.iou for frame in held) > 0.95


def test_the_advice_says_how_far_it_can_be_trusted() -> None:
    ones = torch.ones(N)
    observability = Observability(torch.tensor([0.0, 1.0, 0.0]), torch.tensor([0.01, 0.01, 0.01]))
    bad = PoseQuality(0.3 * ones, 50 * ones, ones, ones, 0.5 * ones, ones < 0, torch.tensor(3.0), observability)
    good = dataclasses.replace(bad, rotation_disagreement=0.01 * ones)
    assert report._what_to_record("No frame.", good, 0) == report._what_to_record("No frame.", None, 0) == "No frame."
    assert report._what_to_record("No frame.", good, 3) == "No frame. 3 frames without a pose are not counted."
    assert report._what_to_record("No frame.", bad, 0).startswith(
        "The poses are not reliable, so this may be wrong: no"
    )


def test_a_small_residual_does_not_hide_a_drift() -> None:
    ones = torch.ones(N)
    observability = Observability(torch.tensor([0.0, 1.0, 0.0]), torch.tensor([0.01, 0.01, 0.01]))
    quality = PoseQuality(0.3 * ones, 50 * ones, ones, ones, 0.5 * ones, ones < 0, torch.tensor(3.0), observability)
    row = health_card._match_row(quality)
    assert row.rating == "bad"
    assert "28.6 degrees" in row.sentence


def test_light_that_is_fixed_to_the_object_comes_from_few_directions(asset: Asset) -> None:
    """At most one cell per bright light; light that is fixed to the camera reaches more."""
    handheld = confidence.confidence_of(asset, asset.camera)
    static_asset = dataclasses.replace(asset, trajectory=dataclasses.replace(asset.trajectory, light="object"))
    static = confidence.confidence_of(static_asset, asset.camera)
    assert static.lights.max() <= confidence.N_LIGHTS < health_card.MIN_LIGHT_DIRECTIONS
    visible = handheld.views > 0
    assert torch.equal(visible, static.views > 0)
    assert handheld.lights[visible].mean() > 2 * static.lights[visible].mean()
    assert (handheld.views >= 0).all()
    assert (handheld.views <= 1).all()


def test_a_lamp_to_the_right_of_the_camera_lights_the_right_side(asset: Asset, monkeypatch: pytest.MonkeyPatch) -> None:
    """One frame, and one light, which is fixed to the camera; its direction is that of a texel of 11 degrees."""
    monkeypatch.setattr(confidence, "N_LIGHTS", 1)
    radiance = torch.full((32, 64, 3), 0.1)
    radiance[15:17, 47:49] = 50.0  # right quarter: +x
    lit = dataclasses.replace(asset, environment=Environment.from_radiance(radiance))
    lit = dataclasses.replace(lit, trajectory=asset.trajectory.select([N // 2]))
    found = confidence.confidence_of(lit, asset.camera)
    x_cam = asset.trajectory.T_cam_obj[N // 2] @ asset.gaussians.means
    visible, side = found.views > 0, x_cam[:, 0] / RADIUS
    assert (found.lights[visible & (side > 0.2)] == 1).all()
    assert (found.lights[visible & (side < -0.2)] == 0).all()
    assert min((visible & (side * sign > 0.2)).sum() for sign in (1, -1)) > 100


def test_the_brightest_directions_are_those_of_the_lights() -> None:
    radiance = torch.full((32, 64, 3), 0.1)
    radiance[14:18, 46:50] = 50.0  # right quarter: +x
    directions = confidence.brightest_directions(Environment.from_radiance(radiance))
    assert directions[0][0] > math.cos(math.radians(10))
    apart = (directions @ directions.T).clamp(-1, 1).acos() + 9 * torch.eye(len(directions))
    assert apart.min() > confidence.MIN_LIGHT_ANGLE - 1e-4


def test_a_window_is_a_square_around_the_object_inside_the_image() -> None:
    mask = torch.zeros(50, 80, dtype=torch.bool)
    mask[2:12, 70:79] = True
    top, left, height, width = training_views.window(mask)
    assert height == width == 14
    assert 0 <= top <= 2
    assert top + height >= 12
    assert left <= 70
    assert 79 <= left + width <= 80
    assert training_views.window(torch.zeros(50, 80, dtype=torch.bool)) == (0, 0, 50, 80)


def test_curves_leave_out_what_is_no_loss() -> None:
    """Of a log from elsewhere; numpy would warn of the arithmetic, and the path would hold "nan"."""
    assert svg.curve([1.0, math.nan, 0.1, math.inf, 1e308, -1e308]) == svg.curve([1.0, 0.1])
    assert svg.curve([math.nan, 2.0]) == ""


def test_bars_leave_gaps_for_nan() -> None:
    drawn = svg.bars([1.0, math.nan, 2.0], ["good", "none", "bad"])
    assert re.findall(r'class="b-(\w+)" x="([\d.]+)" y="([\d.]+)"', drawn) == [
        ("good", "0.1", "50.00"),
        ("bad", "2.1", "0.00"),
    ]
    assert svg.bars([math.nan], ["none"]) == ""


def test_another_capture_is_refused(asset: Asset, capture: Capture) -> None:
    with pytest.raises(BadFile, match=r"mug: is not the capture of this run \(give the right one with --capture\)"):
        report.frames_of_run(capture, asset, ["0000.png", "elsewhere.png"], Path("mug"))


def test_without_a_surface_the_live_view_is_left_out(asset: Asset, capture: Capture, tmp_path: Path) -> None:
    report.build(asset, capture, lambda: None, SUMMARY, None, tmp_path / "report.html")
    source = (tmp_path / "report.html").read_text("utf-8")
    assert "<script" not in source
    assert "#relight" not in re.sub(r"<style>.*?</style>", "", source, flags=re.S)


# In a browser ---------------------------------------------------------------------------------------------------------

LOOK = """(() => {
  const copy = Object.assign(document.createElement("canvas"), { width: 32, height: 32 }).getContext("2d");
  copy.drawImage(document.getElementById("view"), 0, 0, 32, 32);
  return [...copy.getImageData(0, 0, 32, 32).data];
})()"""
"""The image of the live view, as 32 x 32 RGBA code values."""
DROP = """(() => {
  const files = new DataTransfer();
  const bytes = Uint8Array.from(atob(TEXT), (c) => c.charCodeAt(0));
  files.items.add(new File([bytes], NAME));
  dispatchEvent(new DragEvent("drop", { dataTransfer: files, cancelable: true }));
})()"""
SETTLED = "new Promise((done) => requestAnimationFrame(() => requestAnimationFrame(() => done(1))))"
"""Two frames of the screen later."""


def look(tab: devtools.Page) -> np.ndarray:
    tab.value(SETTLED)
    return np.array(tab.value(LOOK)).reshape(32, 32, 4)


def drop(tab: devtools.Page, name: str, text: str) -> None:
    tab.value(DROP.replace("TEXT", text).replace("NAME", json.dumps(name)))


def console_messages(tab: devtools.Page) -> list[str]:
    """Messages of the console, without the software renderer's warnings about its own speed."""
    messages = [str(event) for event in tab.events if event["method"] in ("Runtime.consoleAPICalled", "Log.entryAdded")]
    messages += [str(event) for event in tab.events if event["method"] == "Runtime.exceptionThrown"]
    return [message for message in messages if "GL Driver Message" not in message]


@pytest.mark.slow
@pytest.mark.skipif(devtools.browser() is None, reason=f"needs one of {devtools.BROWSERS}")
@pytest.mark.parametrize("width", [500, 1400])
def test_the_live_view_draws_and_accepts_a_dropped_light(page: Path, tmp_path: Path, width: int) -> None:
    with devtools.opened(page.as_uri(), tmp_path, width, 900) as tab:
        tab.until("document.documentElement.dataset.panel")
        assert tab.value("document.documentElement.dataset.panel") == "drawn"
        assert tab.value("document.documentElement.scrollWidth - innerWidth") <= 0, "wider than the window"
        recovered = look(tab)
        drop(tab, "mine.hdr", 'document.getElementById("sunset").textContent')
        tab.until('document.documentElement.dataset.light === "mine.hdr"')
        dropped = look(tab)
        drop(tab, "mine.jpg", '"AAAA"')
        tab.until('document.getElementById("note").textContent.includes("mine.jpg")')
        assert tab.value('document.getElementById("note").textContent').endswith(
            "only Radiance .hdr files can be used here"
        )
        assert tab.value("document.documentElement.dataset.light") == "mine.hdr"
        tab.value('document.getElementById("view").dispatchEvent(new KeyboardEvent("keydown", { key: "ArrowRight" }))')
        turned = look(tab)
        assert console_messages(tab) == []
    # The sphere covers the middle of the image but not its corners.
    assert recovered[16, 16, 3] == 255
    assert recovered[0, 0, 3] == 0
    solid = recovered[..., 3] == 255
    assert recovered[solid][:, :3].mean() > 20
    assert np.abs(recovered - dropped)[solid].mean() > 5
    assert np.abs(dropped - turned)[solid].mean() > 0.5
