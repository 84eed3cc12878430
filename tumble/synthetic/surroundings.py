"""What surrounds the object on the training frames of a synthetic capture: the hand that holds it, and a background."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from tumble.maths import SE3
from tumble.synthetic.backgrounds import background_parts
from tumble.synthetic.hand import HandMotion, plan, skin_tone
from tumble.synthetic.options import SynthOptions
from tumble.synthetic.pathtracer import ObjectModel, Part


@dataclass(frozen=True)
class Surroundings:
    """Hand and background of a capture."""

    motion: HandMotion | None
    """The grips of the hand; None without a hand."""
    tone: float
    """Skin tone, 0 (light) to 1 (dark)."""
    background: dict[str, Part]
    """Parts in the camera frame."""
    seed: int
    """Seed of the sleeve's colour."""

    def at(self, time: float, T_cam_obj: SE3) -> tuple[dict[str, Part], dict[str, Part]]:
        """Parts of the hand with its arm and of the background by name, in the object frame, at a time [frames] when
        the object has the pose `T_cam_obj`."""
        hand = {} if self.motion is None else self.motion.parts(time, T_cam_obj, self.tone, self.seed)
        T_obj_cam = T_cam_obj.inverse().matrix().double().numpy()
        return hand, {name: _transformed(part, T_obj_cam) for name, part in self.background.items()}


def surroundings(model: ObjectModel, T_cam_obj: SE3, options: SynthOptions, distance: float) -> Surroundings | None:
    """Hand and background that the options ask for; None if they ask for neither.

    Args:
        model: The object.
        T_cam_obj: Poses of the training frames.
        options: Options of the capture.
        distance: Distance of the camera from the object [object radius].
    """
    if not options.hand and options.background == "none":
        return None
    facing = options.background == "torso"
    motion = plan(model, T_cam_obj, facing=facing, seed=options.seed) if options.hand else None
    background = background_parts(options.background, distance, options.seed)
    return Surroundings(motion, skin_tone(options.skin), background, options.seed)


def _transformed(part: Part, T: Float[np.ndarray, "4 4"]) -> Part:
    vertices, normals = part.vertices @ T[:3, :3].T + T[:3, 3], part.normals @ T[:3, :3].T
    return Part(vertices, normals, part.faces, part.uv, part.albedo, part.roughness)
