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
    """A relightable object, as stage 3 puts it out."""

    gaussians: Gaussians
    gamma: Float[Tensor, ""]
    """Sharpness of the opacity, shared by all Gaussians [1 / object radius] (eq. 8)."""
    material: Material
    environment: Environment
    """The light of the capture, env frame of the trajectory."""
    trajectory: Trajectory
    camera: Camera
