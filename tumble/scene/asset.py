"""The reconstructed asset: geometry, material, environment light and motion of an object."""

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
    """A relightable object, the result of stage 3."""

    gaussians: Gaussians
    gamma: Float[Tensor, ""]
    """Sharpness of the opacity, shared by all Gaussians [1 / object radius] (eq. 8)."""
    material: Material
    environment: Environment
    """Light of the capture, in the env frame of the trajectory."""
    trajectory: Trajectory
    camera: Camera
