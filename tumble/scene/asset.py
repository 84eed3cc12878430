"""What a user keeps of a run: the object, its material, the light it was seen under, and how it moved."""

from dataclasses import dataclass

from jaxtyping import Float
from torch import Tensor

from tumble.scene.camera import Camera
from tumble.scene.environment import Environment
from tumble.scene.gaussians import Gaussians
from tumble.scene.material import Material
from tumble.scene.trajectory import Trajectory


@dataclass(frozen=True)
class Asset:
    """A relightable object. Material and environment are None until stage 3 has found them."""

    gaussians: Gaussians
    gamma: Float[Tensor, ""]
    """Sharpness of the opacity, shared by all Gaussians [1 / object radius] (eq. 8)."""
    material: Material | None
    environment: Environment | None
    """The light of the capture, env frame of the trajectory."""
    trajectory: Trajectory
    camera: Camera
