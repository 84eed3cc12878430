"""Conventions of camera and trajectory, on asymmetric cases computed by hand."""

import math

import torch

from tumble.maths.se3 import SE3, SO3
from tumble.scene.camera import Camera
from tumble.scene.trajectory import Trajectory

CAMERA = Camera(torch.tensor([10.0, 20.0, 4.0, 3.0]), height=6, width=9)


def test_a_point_to_the_right_and_below_projects_right_and_below() -> None:
    # x = 1, y = 0.5 at depth 2: u = 10 * 0.5 + 4, v = 20 * 0.25 + 3.
    assert CAMERA.project(torch.tensor([1.0, 0.5, 2.0])).tolist() == [9.0, 8.0]
    assert (CAMERA.matrix @ torch.tensor([1.0, 0.5, 2.0]) / 2).tolist() == [9.0, 8.0, 1.0]


def test_the_first_pixel_has_its_centre_at_one_half() -> None:
    centers = CAMERA.pixel_centers()
    assert centers.shape == (6, 9, 2)
    assert centers[0, 0].tolist() == [0.5, 0.5]
    assert centers[5, 8].tolist() == [8.5, 5.5]


def test_unproject_inverts_project() -> None:
    torch.manual_seed(0)
    x = torch.randn(20, 3) + torch.tensor([0.0, 0.0, 4.0])
    torch.testing.assert_close(CAMERA.unproject(CAMERA.project(x), x[:, 2]), x)
    d = CAMERA.directions()[2, 3]
    torch.testing.assert_close(CAMERA.project(d * 5), torch.tensor([3.5, 2.5]))


def test_resized_and_cropped_cameras_project_to_the_changed_image() -> None:
    x = torch.tensor([0.3, -0.2, 2.0])
    torch.testing.assert_close(CAMERA.resized(12, 18).project(x), 2 * CAMERA.project(x))
    torch.testing.assert_close(CAMERA.cropped(1, 2, 3, 4).project(x), CAMERA.project(x) - torch.tensor([2.0, 1.0]))


def test_the_field_of_view_spans_the_width() -> None:
    camera = Camera.from_fov(math.radians(40), 100, 50)
    assert math.isclose(camera.fov_x, math.radians(40), rel_tol=1e-6)
    left = camera.project(torch.tensor([-math.tan(math.radians(20)), 0.0, 1.0]))
    torch.testing.assert_close(left, torch.tensor([0.0, 50.0]))


def test_transform_matrix_is_camera_to_object_in_opengl_axes() -> None:
    # A camera at z = +4 that looks at the origin, upright: OpenGL camera axes are then the object's own.
    matrix = torch.eye(4)[None].clone()
    matrix[0, 2, 3] = 4.0
    trajectory = Trajectory.from_camera_to_object(matrix, "camera")
    # The object's +y is up in the image, that is -y in OpenCV axes; its +z comes towards the camera.
    x_cam = trajectory.T_cam_obj @ torch.tensor([[0.1, 0.2, 0.3]])
    torch.testing.assert_close(x_cam, torch.tensor([[0.1, -0.2, 3.7]]))
    torch.testing.assert_close(trajectory.camera_positions, torch.tensor([[0.0, 0.0, 4.0]]))
    torch.testing.assert_close(trajectory.camera_to_object(), matrix)


def test_transform_matrices_are_preserved() -> None:
    torch.manual_seed(1)
    matrices = SE3.exp(torch.randn(7, 6)).matrix()
    for light in ("camera", "object"):
        again = Trajectory.from_camera_to_object(matrices, light).camera_to_object()
        torch.testing.assert_close(again, matrices, atol=2e-6, rtol=0)


def test_the_light_is_static_in_the_named_frame() -> None:
    torch.manual_seed(2)
    T_cam_obj = SE3.exp(torch.randn(5, 6))
    assert torch.equal(Trajectory(T_cam_obj, "object").R_env_obj, torch.eye(3).expand(5, 3, 3))
    # An object direction that points up in the image (OpenCV -y) points to the top of the map (env +y).
    up_obj = T_cam_obj.rotation.inverse() @ torch.tensor([0.0, -1.0, 0.0])
    up_env = (Trajectory(T_cam_obj, "camera").R_env_obj @ up_obj[..., None])[..., 0]
    torch.testing.assert_close(up_env, torch.tensor([0.0, 1.0, 0.0]).expand(5, 3), atol=1e-6, rtol=0)
    # What the camera looks at (OpenCV +z) is the centre of the map (env -z).
    ahead = T_cam_obj.rotation.inverse() @ torch.tensor([0.0, 0.0, 1.0])
    ahead_env = (Trajectory(T_cam_obj, "camera").R_env_obj @ ahead[..., None])[..., 0]
    torch.testing.assert_close(ahead_env, torch.tensor([0.0, 0.0, -1.0]).expand(5, 3), atol=1e-6, rtol=0)


def test_selected_frames_keep_their_order() -> None:
    trajectory = Trajectory(SE3.from_rotation(SO3.identity((4,)), torch.arange(12.0).reshape(4, 3)), "camera")
    assert trajectory.select([2, 0]).T_cam_obj.xyz[:, 0].tolist() == [6, 0]
    assert len(trajectory) == 4


def test_zooming_scales_positions_about_the_principal_point() -> None:
    """The offset of a projected point from the principal point is multiplied by the factor."""
    camera = Camera(torch.tensor([100.0, 110.0, 30.0, 20.0]), 40, 60)
    x_cam = torch.tensor([0.1, -0.2, 2.0])
    centre = torch.tensor([30.0, 20.0])
    zoomed = camera.zoomed(1.5).project(x_cam)
    torch.testing.assert_close(zoomed - centre, 1.5 * (camera.project(x_cam) - centre))
    assert (camera.zoomed(1.5).height, camera.zoomed(1.5).width) == (40, 60)
