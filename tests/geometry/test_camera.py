"""Cameras: hits of their rays, framing of the object, and eyes that are refused."""

from dataclasses import replace

import numpy as np
import pytest

from formats.errors import QueryError
from formats.mesh import Mesh, build_mesh
from prt_bake.geometry.camera import Camera, Visibility, directions, fit, pixel_rays, rays, refuse_eye_in_object
from prt_bake.geometry.nesting import distances
from prt_bake.lights.environment import rotation
from tests.shapes import ball, ring

MIDDLE = np.array([[0.5, 0.5]])


def coverage(mesh: Mesh, camera: Camera) -> np.ndarray:
    """Coverage of the picture by the mesh, one ray per pixel: bool [H,W]."""
    hits = Visibility(mesh).first_hits(*rays(camera, slice(None), MIDDLE).rows())
    return (hits.faces >= 0).reshape(camera.height, camera.width)


def test_central_ray_hits_the_target_and_edges_are_half_the_field_of_view_away():
    camera = Camera(np.array([1.0, 2.0, 3.0]), np.array([4.0, -1.0, 2.0]), np.array([0.0, 3.0, 0.0]), 40.0, 3, 2)
    forward = (camera.target - camera.eye) / np.linalg.norm(camera.target - camera.eye)
    corner = np.array([[0.0, 0.0], [0.5, 0.0]])
    rays = directions(camera, slice(None), corner)
    np.testing.assert_allclose(np.linalg.norm(rays, axis=-1), 1, atol=1e-15)
    np.testing.assert_allclose(rays[1, 1, 1], forward, atol=1e-15)
    above = rays[0, 1, 1]
    assert np.degrees(np.arccos(above @ forward)) == pytest.approx(20.0, abs=1e-12)
    assert above[1] > forward[1]
    right = np.cross(forward, camera.up)
    assert rays[1, 0, 1] @ right < 0 < rays[1, 2, 1] @ right
    assert np.array_equal(directions(camera, slice(1, 2), corner), rays[1:2])


def test_hits_agree_with_a_sphere():
    mesh = ball(5)
    rng = np.random.default_rng(1)
    origins = 3 * rng.normal(size=(2000, 3))
    origins = origins[np.linalg.norm(origins, axis=1) > 1.01]
    rays = rng.normal(size=origins.shape)
    rays[::2] -= 3 * origins[::2]
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    along = -np.sum(origins * rays, axis=1)
    closest = np.linalg.norm(origins + along[:, None] * rays, axis=1)
    hits = Visibility(mesh).first_hits(origins, rays)
    met = hits.faces >= 0
    sure = np.abs(closest - 1) > 0.01
    assert np.array_equal(met[sure], ((closest < 1) & (along > 0))[sure])
    assert 400 < met.sum() < len(rays) - 400
    u, v = hits.barycentric[met].T[..., None]
    a, b, c = np.moveaxis(mesh.positions[mesh.faces[hits.faces[met]]], 1, 0)
    points = (1 - u - v) * a + u * b + v * c
    # Hits are on their rays, on the near side of the ball.
    off = np.linalg.norm(np.cross(points - origins[met], rays[met]), axis=1)
    assert off.max() < 1e-5
    assert (np.sum(mesh.face_normals[hits.faces[met]] * rays[met], axis=1) < 1e-6).all()


@pytest.mark.parametrize("distance", [3.0, 1e3, 1e6, 1e9])
def test_distance_of_the_eye_costs_no_precision(distance):
    mesh = ball(4)
    rng = np.random.default_rng(2)
    points = rng.normal(size=(500, 2))
    points *= 0.9 * rng.random((500, 1)) ** 0.5 / np.linalg.norm(points, axis=1, keepdims=True)
    origins = np.column_stack([points, np.full(500, distance)])
    rays = np.tile([0.0, 0.0, -1.0], (500, 1))
    near = Visibility(mesh).first_hits(origins - [0, 0, distance - 2], rays)
    far = Visibility(mesh).first_hits(origins, rays)
    assert (near.faces >= 0).all()
    assert np.array_equal(far.faces, near.faces)
    np.testing.assert_allclose(far.barycentric, near.barycentric, atol=1e-4)


def test_pictures_do_not_depend_on_the_object_s_position():
    here = ball(4)
    there = build_mesh(here.positions + np.array([3e6, -1e6, 2e6]), here.faces)
    assert np.array_equal(coverage(here, fit(here, 40, 30)), coverage(there, fit(there, 40, 30)))


def test_rays_hit_nothing_behind_the_eye():
    mesh = ball(3)
    away = Camera(np.array([0.0, 0.0, 3.0]), np.array([0.0, 0.0, 9.0]), np.array([0.0, 1.0, 0.0]), 60.0, 16, 16)
    assert not coverage(mesh, away).any()


@pytest.mark.parametrize("up", ["y", "z"])
@pytest.mark.parametrize("size", [(40, 40), (80, 30), (30, 80)])
def test_fit_fills_the_frame_with_the_object(size, up):
    mesh = build_mesh(ball(4).positions * [0.3, 1.0, 2.0] + [5.0, 0.0, 0.0], ball(4).faces)
    covered = coverage(mesh, fit(mesh, *size, up=up))
    assert covered.shape == size[::-1]
    assert not np.concatenate([covered[[0, -1]].ravel(), covered[:, [0, -1]].ravel()]).any()
    # The tightest side has a margin of 8 % of the half frame, within a pixel.
    lines = [covered.any(axis=1), covered.any(axis=0)]
    margins = [min(line.argmax(), line[::-1].argmax()) - 0.5 * (1 - 1 / 1.08) * len(line) for line in lines]
    assert min(margins) < 1


@pytest.mark.parametrize("up", ["y", "z"])
@pytest.mark.parametrize("orthographic", [False, True])
def test_fit_to_all_turns_holds_for_every_turn(up, orthographic):
    # The object is longest along the first view.
    mesh = build_mesh(ball(4).positions * ([0.6, 0.6, 3.0] if up == "y" else [0.6, 3.0, 0.6]) + 5.0, ball(4).faces)
    target = mesh.center + 0.2

    def margin(turns: int) -> int:
        """Smallest distance in pixels between object and edge over 24 turns."""
        view, margins = fit(mesh, 60, 45, up=up, target=target, orthographic=orthographic, turns=turns), []
        for degrees in range(0, 360, 15):
            eye = target + rotation(degrees, up) @ (view.eye - target)
            covered = coverage(mesh, replace(view, eye=eye))
            lines = [covered.any(axis=1), covered.any(axis=0)]
            margins.append(min(min(line.argmax(), line[::-1].argmax()) for line in lines))
        return min(margins)

    assert margin(1) == 0
    assert 1 <= margin(24) <= 4
    assert margin(24) <= margin(3600) + 1


def test_z_up_is_y_up_rotated():
    mesh = ball(3)
    turn = np.array([[1, 0, 0], [0, 0, -1], [0, 1, 0]])
    one = fit(build_mesh(mesh.positions * [1, 2, 3], mesh.faces), 20, 20, up="y")
    other = fit(build_mesh((mesh.positions * [1, 2, 3]) @ turn.T, mesh.faces), 20, 20, up="z")
    np.testing.assert_allclose(other.eye, turn @ one.eye, atol=1e-12)
    np.testing.assert_allclose(other.up, turn @ one.up, atol=1e-12)


def test_view_along_the_up_axis_works():
    mesh = ball(3)
    assert coverage(mesh, fit(mesh, 21, 21, eye=(0, 4, 0)))[10, 10]


@pytest.mark.parametrize(
    ("change", "expected"),
    [
        ({"eye": (np.nan, 0, 0)}, "three finite numbers"),
        ({"eye": (1, 2)}, "three finite numbers"),
        ({"eye": (0, 0, 1e300)}, r"within ±1e\+30 for eye"),
        ({"target": (0, 0, -2e30)}, r"within ±1e\+30 for target"),
        ({"eye": None, "fov": 1e-300}, r"within ±1e\+30 for eye"),
        ({"extent": 1e300}, r"up to 1e\+30 scene units"),
        ({"eye": (0, 0, 0)}, "off the target"),
        ({"width": 0}, "found 0x8"),
        ({"fov": 180.0}, "between 0 and 180 degrees, found 180"),
        ({"fov": float("nan")}, "between 0 and 180 degrees, found nan"),
        ({"up": "x"}, "'x'"),
    ],
)
def test_invalid_cameras_are_refused(change, expected):
    with pytest.raises(QueryError, match=expected):
        fit(ball(3), **{"width": 8, "height": 8, "eye": (0, 0, 5), **change})


@pytest.mark.parametrize("inside_out", [False, True])
def test_eye_inside_is_refused_but_a_hole_is_outside(inside_out):
    mesh = ring()
    if inside_out:
        mesh = build_mesh(mesh.positions, mesh.faces[:, ::-1])
    for outside in ([0, 0, 0], [0, 0.3, 0], [0.5, 0, 0], [1, 0.45, 0], [9, 9, 9], [1.39, 0, 1.39]):
        refuse_eye_in_object(mesh, np.array(outside, np.float64))
    for inside in ([1, 0, 0], [0, 0.1, -1.2], [0.7, 0, 0.7]):
        with pytest.raises(QueryError, match="inside the object"):
            refuse_eye_in_object(mesh, np.array(inside, np.float64))


def test_eye_on_the_surface_is_refused():
    mesh = ring()
    triangle = mesh.positions[mesh.faces[7]]
    step = 1e-5 * mesh.diagonal * mesh.face_normals[7]
    for on_it in (triangle[0], 0.5 * (triangle[0] + triangle[1]), triangle.mean(axis=0) + step):
        with pytest.raises(QueryError, match="on the surface"):
            refuse_eye_in_object(mesh, on_it)
    refuse_eye_in_object(mesh, triangle.mean(axis=0) + 100 * step)
    collapsed = np.concatenate([mesh.faces, [[5, 5, 5], [1, 1, 2]]])
    with pytest.raises(QueryError, match="on the surface"):
        refuse_eye_in_object(Mesh(mesh.positions, collapsed, mesh.normals), triangle[0])


def test_a_face_without_area_is_not_below_every_eye():
    mesh = ring()
    collapsed = Mesh(mesh.positions, np.concatenate([mesh.faces, [[1, 1, 2]]]), mesh.normals)
    eye = np.array([0.0, 0.0, 0.0])
    refuse_eye_in_object(mesh, eye)
    refuse_eye_in_object(collapsed, eye)
    np.testing.assert_allclose(distances(collapsed, eye[None]), distances(mesh, eye[None]))


def test_eye_in_line_with_an_edge_is_accepted():
    mesh = ball(1)
    edges = mesh.positions[mesh.faces[:, 1]] - mesh.positions[mesh.faces[:, 0]]
    beyond = mesh.positions[mesh.faces[:, 1]] + 0.2 * edges
    low, high = mesh.bounds
    within_box = beyond[((beyond > low) & (beyond < high)).all(axis=1)]
    assert len(within_box) > 5
    for eye in within_box:
        refuse_eye_in_object(mesh, eye)


def test_orthographic_rays_are_parallel_and_start_in_the_plane_through_the_eye() -> None:
    view = Camera(np.array([3.0, 1.0, -4.0]), np.array([1.0, 0.0, 0.0]), np.array([0.0, 1.0, 0.0]), 30.0, 6, 4, 2.0)
    origins, towards = rays(view, slice(None), np.array([[0.5, 0.5], [0.0, 0.0]]))
    np.testing.assert_allclose(towards, np.broadcast_to(view.forward, towards.shape))
    np.testing.assert_allclose((origins - view.eye) @ view.forward, 0.0, atol=1e-14)
    # Two units from the lower to the upper edge, square pixels, x to the right and y down.
    np.testing.assert_allclose(np.linalg.norm(origins[0, 0, 0] - origins[3, 0, 0]), 1.5)
    np.testing.assert_allclose(np.linalg.norm(origins[0, 0, 0] - origins[0, 5, 0]), 2.5)
    assert (origins[0, 0, 1] - origins[3, 0, 1])[1] > 0.0
    assert (origins[0, 5, 1] - origins[0, 0, 1]) @ np.cross(view.forward, view.up) > 0.0
    pixels = np.arange(24)
    by_pixel = pixel_rays(view, pixels, np.full((24, 1, 2), 0.5))
    np.testing.assert_allclose(by_pixel.origins[:, 0], origins[:, :, 0].reshape(-1, 3))


@pytest.mark.parametrize("eye", [None, [5.0, 1.0, 2.0], [0.0, -7.0, 0.01]])
@pytest.mark.parametrize(("width", "height"), [(64, 64), (96, 32), (32, 96)])
def test_orthographic_camera_frames_the_object_from_any_eye(eye, width, height) -> None:
    mesh = ring()
    view = fit(mesh, width, height, eye, orthographic=True)
    seen = coverage(mesh, view)
    assert seen.any()
    assert not np.concatenate([seen[[0, -1]].ravel(), seen[:, [0, -1]].ravel()]).any()
    assert max(seen.any(axis=0).mean(), seen.any(axis=1).mean()) > 0.8


def test_orthographic_picture_is_the_limit_of_distant_perspective() -> None:
    mesh = ring()
    far = 1e5 * np.array([0.3, 0.4, -0.8])
    parallel = fit(mesh, 48, 48, far, orthographic=True)
    distance = np.linalg.norm(far - parallel.target)
    fov = 2.0 * np.degrees(np.arctan(0.5 * parallel.extent / distance))
    perspective = fit(mesh, 48, 48, far, fov=fov)
    assert (coverage(mesh, parallel) != coverage(mesh, perspective)).mean() < 0.01
    np.testing.assert_allclose(parallel.towards(mesh.positions) @ parallel.forward, -1.0)


def test_camera_looks_at_its_target() -> None:
    mesh = ball(3)
    view = fit(mesh, 33, 33, [0.0, 0.0, 5.0], target=[1.0, 0.0, 0.0], fov=60.0)
    seen = coverage(mesh, view)
    columns = np.flatnonzero(seen.any(axis=0))
    assert columns.mean() < 14
    assert coverage(mesh, fit(mesh, 33, 33, target=[0.5, 0.0, 0.0])).any()
    for wrong in (0.0, -1.0, np.inf, np.nan):
        with pytest.raises(QueryError, match="extent"):
            fit(mesh, 8, 8, extent=wrong)


@pytest.mark.parametrize(
    ("view", "y_up", "z_up"),
    [
        ("front", [0, 0, 1], [0, -1, 0]),
        ("back", [0, 0, -1], [0, 1, 0]),
        ("right", [1, 0, 0], [1, 0, 0]),
        ("left", [-1, 0, 0], [-1, 0, 0]),
        ("three-quarter", [0.43, 0.24, 0.87], [0.43, -0.87, 0.24]),
        ("three-quarter-back", [-0.43, 0.24, -0.87], [-0.43, 0.87, 0.24]),
        (None, [0.43, 0.24, 0.87], [0.43, -0.87, 0.24]),
    ],
)
def test_each_view_is_from_its_side(view, y_up, z_up):
    """Front is +z in glTF, which has y up, and −y in Blender, which has z up; right is +x in both."""
    mesh = build_mesh(ball(2).positions + np.array([5.0, 6.0, 7.0]), ball(2).faces)
    for up, expected in (("y", y_up), ("z", z_up)):
        for options in ({}, {"orthographic": True}):
            camera = fit(mesh, 20, 20, up=up, view=view, **options)
            towards = -camera.forward
            np.testing.assert_allclose(towards, expected / np.linalg.norm(expected), atol=1e-12)


def test_views_that_are_unknown_or_beside_an_eye_are_refused():
    mesh = ball(1)
    with pytest.raises(QueryError, match=r"camera: expected a view of front, back, left, .*, found 'top'"):
        fit(mesh, view="top")
    with pytest.raises(QueryError, match=r"expected a view or an eye, found both, 'front' and \[0, 0, 9\]"):
        fit(mesh, view="front", eye=[0, 0, 9])
