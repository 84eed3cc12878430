"""The reconstructed asset: geometry, material, environment light and motion of an object."""

from dataclasses import dataclass, replace

import torch
from jaxtyping import Float
from torch import Tensor

from tumble.maths import SE3, SO3, fibonacci_sphere
from tumble.maths import spherical_harmonics as harmonics
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

    def rotated(self, R_new_obj: Float[Tensor, "3 3"]) -> "Asset":
        """The same object, motion and light in a rotated object frame; a light fixed to the object is resampled."""
        gaussians, trajectory = self.gaussians, self.trajectory
        turned = Gaussians(
            gaussians.means @ R_new_obj.mT,
            SO3.from_matrix(R_new_obj @ gaussians.R_obj_local).wxyz,
            gaussians.log_scales,
            gaussians.sdf,
            _rotated_harmonics(gaussians.sh, R_new_obj),
        )
        material = replace(self.material, normal_offset=self.material.normal_offset @ R_new_obj.mT)
        T_cam_new = trajectory.T_cam_obj @ SE3.from_rotation_matrix(R_new_obj.mT)
        fixed_to_object = trajectory.light == "object"
        environment = self.environment.rotated(R_new_obj) if fixed_to_object else self.environment
        turns = trajectory.light_turns
        if turns is not None and fixed_to_object:
            turns = R_new_obj @ turns @ R_new_obj.mT
        motion = Trajectory(T_cam_new, trajectory.light, turns)
        return Asset(turned, self.gamma, material, environment, motion, self.camera)


def _rotated_harmonics(sh: Float[Tensor, "n k 3"], R_new_obj: Float[Tensor, "3 3"]) -> Float[Tensor, "n k 3"]:
    """Coefficients of the same functions of direction in a rotated frame, fitted exactly to samples on the sphere."""
    degree = round(sh.shape[1] ** 0.5) - 1
    d_new = fibonacci_sphere(4 * sh.shape[1], dtype=torch.float64).to(sh.device)
    old, new = harmonics.basis(d_new @ R_new_obj.double(), degree), harmonics.basis(d_new, degree)
    return torch.linalg.lstsq(new, old).solution.to(sh) @ sh
