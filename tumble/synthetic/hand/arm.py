"""Meshes of a posed hand and its forearm, with skin and sleeve."""

from functools import cache

import cv2
import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from tumble.synthetic.hand.rig import DIGITS, WRIST_END, Rig, read_rig
from tumble.synthetic.pathtracer import Part
from tumble.synthetic.surfaces import noise, pattern, smooth_normals, tube

TONES = {"light": 0.0, "medium": 0.5, "dark": 1.0}
"""Skin tones by name."""
LIGHT, DARK = np.array([0.62, 0.37, 0.27]), np.array([0.085, 0.043, 0.028])
"""Albedo of the back of the hand of tones 0 and 1 [linear RGB]; the tones between are interpolated in the logarithm."""
PALM = 0.4
"""Tone of the palm in relation to that of the back of the hand: palms are lighter."""
TEXTURE = 512
"""Height and width of the skin's texture [pixels]."""
SKIN_ROUGHNESS = 0.5
"""Perceptual roughness of skin."""
CLOTHS = ((0.05, 0.09, 0.22), (0.35, 0.06, 0.05), (0.10, 0.16, 0.09), (0.45, 0.42, 0.38), (0.03, 0.03, 0.035))
"""Albedos of sleeves, one of which is drawn [linear RGB]."""
INSIDE = 0.014
"""Depth inside the hand at which the forearm begins [metres]."""
CUFF = 0.055
"""Length of the forearm that the sleeve leaves bare [metres]."""
ELBOW_RADIUS = 0.047
"""Radius of the forearm at the elbow [metres]."""
MIN_FOREARM = 0.09
"""Distance from the wrist at which the elbow is put if the forearm is shorter than what the sleeve leaves bare, because
beside a large object the hand is small, and the border of the image as near [metres]."""
BEND_LENGTH = 0.07
"""Distance behind the wrist over which the forearm turns to the elbow [metres]."""


def skin_tone(skin: str | float) -> float:
    """Skin tone between 0 (light) and 1 (dark) of a name in `TONES`, or of the tone itself."""
    return TONES[skin] if isinstance(skin, str) else skin


def skin_colour(tone: float) -> Float[np.ndarray, "3"]:
    """Albedo of skin [linear RGB] of a tone between 0 (light) and 1 (dark)."""
    return np.exp((1 - tone) * np.log(LIGHT) + tone * np.log(DARK))


@cache
def skin_texture(tone: float) -> Float[np.ndarray, "h w 3"]:
    """Albedo of the hand's skin in its texture coordinates: mottled, with a lighter palm, redder knuckles and
    fingertips, and nails."""
    rig = read_rig()
    points, normals, filled = _unwrapped()
    bind = rig.bind.numpy()
    palmar = (0.5 - 0.9 * normals @ bind[0, :3, 1]).clip(0, 1)[..., None]
    colour = np.exp((1 - palmar) * np.log(skin_colour(tone)) + palmar * np.log(skin_colour(PALM * tone)))
    mottling = 0.25 * noise(points / 0.012, 1) + 0.15 * noise(points / 0.004, 2) + 0.12 * noise(points / 0.0015, 3)
    colour *= np.exp(mottling[..., None] * np.array([0.6, 1.0, 1.1]))
    for digit, chain in zip(DIGITS, rig.chains.tolist(), strict=True):
        dorsal = (normals @ bind[chain[-1], :3, 1]).clip(0, 1)
        knuckles = chain if digit != "thumb" else chain[1:]
        for joint in (*knuckles, chain[-1] + 1):
            near = np.exp(-(((points - bind[joint, :3, 3]) ** 2).sum(-1)) / 0.009**2)
            weight = near if joint not in knuckles else near * dorsal
            colour *= np.exp(-weight[..., None] * np.array([0.06, 0.28, 0.3]))
        nail = _nail(bind[chain[-1] + 1], points, normals, wide=digit == "thumb")[..., None]
        colour = (1 - nail) * colour + nail * (0.5 * colour + 0.5 * np.array([0.62, 0.42, 0.36]))
    colour[~filled] = skin_colour(tone)
    return _bled(colour, filled)


def _nail(tip: np.ndarray, points: np.ndarray, normals: np.ndarray, *, wide: bool) -> Float[np.ndarray, "h w"]:
    """1 on the nail of the digit with the frame `tip` at its fingertip."""
    local = (points - tip[:3, 3]) @ tip[:3, :3]
    half = 0.0065 if wide else 0.0048
    shape = (local[..., 0] / half) ** 4 + ((local[..., 2] - 0.0045) / 0.0075) ** 4
    return ((shape < 1) & (normals @ tip[:3, 1] > 0.45)).astype(np.float64)


@cache
def _position(rig_vertices: bytes) -> np.ndarray:
    """Number of each vertex's position: vertices on both sides of a texture seam share one."""
    vertices = np.frombuffer(rig_vertices).reshape(-1, 3)
    return np.unique(np.round(vertices * 1e6).astype(np.int64), axis=0, return_inverse=True)[1].reshape(-1)


@cache
def _unwrapped() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Position [metres], unit normal and occupancy of every texel in the bind pose."""
    rig = read_rig()
    vertices, faces = rig.vertices.numpy(), rig.faces.numpy()
    attributes = np.concatenate([vertices, smooth_normals(vertices, faces, _position(vertices.tobytes()))], 1)
    corners = rig.uv.numpy()[faces] * TEXTURE - 0.5
    owner = np.full((TEXTURE, TEXTURE), -1, np.int32)
    for number, triangle in enumerate(corners.round().astype(np.int32)):
        cv2.fillConvexPoly(owner, triangle, number)
    at = np.stack(np.meshgrid(np.arange(TEXTURE), np.arange(TEXTURE)), -1)
    a, b, c = (corners[owner, i] - at for i in range(3))
    areas = np.stack([p[..., 0] * q[..., 1] - p[..., 1] * q[..., 0] for p, q in ((b, c), (c, a), (a, b))], -1)
    shares = (areas / areas.sum(-1, keepdims=True)).clip(0, 1)
    values = (shares[..., None] * attributes[faces[owner]]).sum(-2) / shares.sum(-1)[..., None]
    normals = values[..., 3:] / np.linalg.norm(values[..., 3:], axis=-1, keepdims=True).clip(1e-9)
    return values[..., :3], normals, owner >= 0


def _bled(colour: np.ndarray, filled: np.ndarray) -> Float[np.ndarray, "h w 3"]:
    """The texture with its islands grown by some texels, so that interpolation at their borders stays inside."""
    for _ in range(4):
        total, count = np.zeros_like(colour), np.zeros(filled.shape)
        for shift, axis in ((1, 0), (-1, 0), (1, 1), (-1, 1)):
            neighbour = np.roll(filled, shift, axis)
            total += np.roll(colour, shift, axis) * neighbour[..., None]
            count += neighbour
        grown = ~filled & (count > 0)
        colour[grown] = total[grown] / count[grown][:, None]
        filled = filled | grown
    return colour


def hand_part(rig: Rig, vertices: Float[Tensor, "v 3"], tone: float) -> Part:
    """The mesh of a posed hand with its skin, in the frame and unit of `vertices`."""
    points, faces = vertices.numpy(), rig.faces.numpy()
    normals = smooth_normals(points, faces, _position(rig.vertices.numpy().tobytes()))
    rough = np.full((1, 1, 1), SKIN_ROUGHNESS)
    return Part(points, normals, faces, rig.uv.numpy(), skin_texture(tone), rough)


def forearm_curve(
    wrist: Float[Tensor, "*b 3"], back: Float[Tensor, "*b 3"], elbow: Float[Tensor, "*b 3"], metre: float
) -> Float[Tensor, "*b n 3"]:
    """Points along the axis of a forearm: it leaves the wrist straight and bends to the elbow.

    Args:
        wrist: Position of the wrist.
        back: Unit direction from the hand into the forearm.
        elbow: Position of the elbow.
        metre: Length of a metre in the unit of the positions.
    """
    t = torch.linspace(0, 1.15, 28, dtype=wrist.dtype)[:, None]
    wrist, bend, elbow = (x[..., None, :] for x in (wrist, wrist + BEND_LENGTH * metre * back, elbow))
    return (1 - t) ** 2 * wrist + 2 * t * (1 - t) * bend + t**2 * elbow


def forearm_parts(
    rig: Rig, T_obj_hand: Float[Tensor, "4 4"], elbow: Float[Tensor, "3"], metre: float, tone: float, seed: int
) -> dict[str, Part]:
    """Bare forearm and sleeve, from the wrist of a hand to beyond the elbow.

    Args:
        rig: The hand, in object radii.
        T_obj_hand: Hand to object frame.
        elbow: Position of the elbow in the object frame.
        metre: Length of a metre [object radius].
        tone: Skin tone.
        seed: Seed of the sleeve's colour.
    """
    axes = (T_obj_hand @ rig.bind[0])[:3]
    local = (rig.vertices - rig.bind[0, :3, 3]) @ rig.bind[0, :3, :3]
    end = local[(local[:, 2] - WRIST_END * metre).abs() < 0.005 * metre]
    half = (end.amax(0) - end.amin(0))[:2].numpy() / 2
    middle = torch.cat([(end.amax(0) + end.amin(0))[:2] / 2, end.new_tensor([-INSIDE * metre])])
    start = axes[:, 3] + axes[:, :3] @ middle
    cuff, overlap = CUFF * metre, (CUFF + 0.03) * metre
    curve = forearm_curve(start, axes[:, 2], elbow, metre).numpy()
    if _lengths(curve)[-1] <= overlap:
        away = torch.nn.functional.normalize(elbow - start, dim=0)
        curve = forearm_curve(start, axes[:, 2], start + MIN_FOREARM * metre * away, metre).numpy()
    length = _lengths(curve)
    # The same number of rings at every length: the path tracer moves vertices, it does not add any.
    fine = np.concatenate(
        [np.linspace(0, cuff, 13)[:-1], np.linspace(cuff, overlap, 3)[:-1], np.linspace(overlap, length[-1], 46)]
    )
    bare, covered = fine <= overlap, fine >= cuff
    curve = np.stack([np.interp(fine, length, curve[:, i]) for i in range(3)], -1)
    share = (fine / (0.24 * metre)).clip(0, 1)[:, None] ** 0.7
    # The bare forearm grows out of the hand's mesh, so that the end of the mesh lies inside.
    emerging = 0.78 + 0.3 * (fine / ((INSIDE + WRIST_END) * metre)).clip(0, 1)[:, None]
    radii = (1 - share) * half * emerging + share * ELBOW_RADIUS * metre
    colour = np.asarray(CLOTHS[np.random.default_rng(seed).integers(len(CLOTHS))])
    cloth = pattern(np.stack([0.75 * colour, 1.2 * colour]), (40, 40), seed)
    skin = pattern(np.stack([0.88 * skin_colour(tone), 1.1 * skin_colour(tone)]), (6, 3), 3)
    rings = _rings(curve, radii, axes[:, 0].numpy(), 28)
    wrinkles = 1.18 + 0.1 * noise(rings / (0.025 * metre), seed + 5)[covered, :, None]
    sleeve = curve[covered, None] + wrinkles * (rings[covered] - curve[covered, None])
    sleeve[0] = curve[covered][0] + 0.9 * (sleeve[0] - curve[covered][0])
    return {"forearm": tube(rings[bare], skin, SKIN_ROUGHNESS), "sleeve": tube(sleeve, cloth, 0.9, repeats=2)}


def _lengths(curve: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, " n"]:
    """Length of a curve from its beginning to each of its points."""
    return np.concatenate([[0.0], np.linalg.norm(np.diff(curve, axis=0), axis=1).cumsum()])


def _rings(
    curve: Float[np.ndarray, "n 3"], radii: Float[np.ndarray, "n 2"], across: Float[np.ndarray, "3"], columns: int
) -> Float[np.ndarray, "n columns 3"]:
    """Ellipses around a curve, whose first half axis is carried along without twist from the direction `across`."""
    angle = np.linspace(0, 2 * np.pi, columns, endpoint=False)[:, None]
    rings = []
    for point, tangent, (wide, thick) in zip(curve, np.gradient(curve, axis=0), radii, strict=True):
        tangent = tangent / np.linalg.norm(tangent)
        across = across - (across @ tangent) * tangent
        across = across / np.linalg.norm(across)
        rings.append(point + wide * np.cos(angle) * across + thick * np.sin(angle) * np.cross(tangent, across))
    return np.stack(rings)
