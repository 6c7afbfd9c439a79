"""Mitsuba as a reference, on nested scenes with analytic solutions.

These tests verify the export (nesting, indices, media, grids, textures) and the manual start of paths. z-tests at
`significance.FALSE_ALARM` unless a result has no noise.
"""

from pathlib import Path

import numpy as np
import pytest

from formats.mesh import Mesh
from tests.mathematics.significance import assert_agree
from tests.tracer.nested_scenes import CLEAR, nested_scene
from tests.tracer.optical_depth import crossings
from tests.tracer.scenes import moved, sphere, unit_directions

pytestmark = pytest.mark.statistics

BALL = sphere(2)
VIEW = np.array([0.12, 0.05, 0.99])
VIEW /= np.linalg.norm(VIEW)
SCATTERING = {"sigma_t": 3.0, "albedo": 1.0, "phase_g": 0.4}


def from_above(mesh: Mesh) -> tuple[np.ndarray, np.ndarray]:
    """A point on the upper side of the outermost mesh, off its axis, and the direction to the eye."""
    face = int(np.argmax(np.asarray(mesh.face_normals) @ np.array([0.2, 0.1, 0.97])))
    return mesh.positions[mesh.faces[face]].T @ np.array([0.5, 0.3, 0.2]), VIEW


def chords(scene, position: np.ndarray, outgoing: np.ndarray) -> list[float]:
    """Length of the straight line within each part, including its inner parts."""
    start_point = (position - 1e-9 * outgoing)[None]
    lengths = []
    for part in scene.parts:
        ends = crossings(_SinglePart(part.mesh), start_point, -outgoing)[0]
        ends = ends[np.isfinite(ends)]
        lengths.append(float(ends[0]) if len(ends) == 1 else float(ends[1] - ends[0]))
    return lengths


class _SinglePart:
    def __init__(self, mesh: Mesh) -> None:
        self.mesh = mesh


def test_transmittance_through_nested_parts_far_from_the_origin(tmp_path: Path) -> None:
    """Black index-matched chromatic media: exp(−∫ σt), each medium in its own part only."""
    from tests.tracer.mitsuba_reference import under_white_sky

    far = np.array([3e5, -1e5, 2e5])
    extinction = [np.array([0.5, 0.2, 0.8]), np.array([0.0, 1.0, 0.5]), np.array([2.0, 0.5, 0.0])]
    tables = [{"sigma_t": sigma_t.tolist(), "albedo": 0.0} for sigma_t in extinction]
    grid = np.broadcast_to(extinction[1], (2, 2, 2, 3))
    low, high = far - 1.0, far + 1.0
    scene = nested_scene(
        tmp_path,
        moved(BALL, 1.0, far),
        tables[0],
        (
            {
                "name": "shell",
                "mesh": moved(BALL, 0.8, far),
                "medium": {"sigma_t": grid, "albedo": 0.0, "bounds": [low.tolist(), high.tolist()]},
            },
            {"name": "core", "mesh": moved(BALL, 0.5, far), "in": "shell", "medium": tables[2]},
        ),
    )
    position, outgoing = from_above(scene.mesh)
    outer, shell, core = chords(scene, position, outgoing)
    lengths = [outer - shell, shell - core, core]
    expected = np.exp(-sum(length * sigma_t for length, sigma_t in zip(lengths, extinction, strict=True)))
    mean, error = under_white_sky(scene, position, outgoing, 20_000, 1)
    assert (error > 0.0).all()
    assert (error < 0.02).all()
    assert_agree(mean, error, expected)


@pytest.mark.parametrize("parallel", [(), (1.0,)])
def test_diffuse_ball_in_a_vacuum_is_lambertian(tmp_path: Path, parallel: tuple[float, ...]) -> None:
    """ρ/π max(0, n·ωi) of the visible face; an index-matched shell of vacuum around it changes nothing."""
    from tests.tracer.mitsuba_reference import transport

    shells = tuple({"name": "air", "mesh": moved(BALL, 0.9)} for _ in parallel)
    home = {"in": "air"} if parallel else {}
    ball = {"mesh": moved(BALL, 0.6), "surface": "diffuse", "reflectance": [0.2, 0.5, 0.9], **home}
    scene = nested_scene(tmp_path, BALL, CLEAR, (*shells, ball))
    position, outgoing = from_above(scene.mesh)
    inner = scene.parts[-1].mesh
    result = inner.face_normals[first_face(inner, position, outgoing)]
    nonzero = 0
    for incident in unit_directions(6, 3):
        expected = np.array([0.2, 0.5, 0.9]) / np.pi * max(0.0, float(result @ incident))
        mean, _ = transport(scene, position, outgoing, incident, 4, 1)
        np.testing.assert_allclose(mean, expected, rtol=1e-4, atol=1e-7)
        nonzero += bool(expected.any())
    assert 0 < nonzero < 6


def first_face(mesh: Mesh, position: np.ndarray, outgoing: np.ndarray) -> int:
    """The first face that the view ray hits, by testing every face."""
    a, b, c = np.moveaxis(mesh.positions[mesh.faces], 1, 0)
    facing = mesh.face_normals @ outgoing > 0.0
    distance = np.einsum("fi,fi->f", position - a, mesh.face_normals) / (mesh.face_normals @ outgoing)
    points = position - distance[:, None] * outgoing
    inside = np.ones(len(a), bool)
    for start, end in ((a, b), (b, c), (c, a)):
        inside &= np.einsum("fi,fi->f", np.cross(end - start, points - start), mesh.face_normals) > 0.0
    (face,) = np.flatnonzero(facing & inside & (distance > 0.0))
    return int(face)


def test_reflectance_texture_has_v_upwards_and_preserves_seams(tmp_path: Path) -> None:
    """Every face has its own texel."""
    from tests.tracer.mitsuba_reference import transport

    ball = moved(BALL, 0.6)
    image = np.random.default_rng(4).uniform(0.1, 0.9, (4, 5, 3))
    rows, columns = np.divmod(np.arange(len(ball.faces)) % 20, 5)
    # All three corners at one texel's centre, so that there is no interpolation.
    uv = np.stack([(columns + 0.5) / 5, 1.0 - (rows + 0.5) / 4], axis=1)
    corner_uv = np.repeat(uv[:, None], 3, axis=1)
    ball = Mesh(ball.positions, ball.faces, ball.normals, np.zeros((len(ball.positions), 2)), corner_uv)
    scene = nested_scene(tmp_path, BALL, CLEAR, ({"mesh": ball, "surface": "diffuse", "reflectance": image},))
    position, outgoing = from_above(scene.mesh)
    inner = scene.parts[1].mesh
    face = first_face(inner, position, outgoing)
    incident = inner.face_normals[face]
    row, column = divmod(face % 20, 5)
    mean, _ = transport(scene, position, outgoing, incident, 4, 1)
    np.testing.assert_allclose(mean, image[row, column] / np.pi, rtol=1e-4)


INSIDES = {
    "matched": {"mesh": moved(BALL, 0.6), "medium": {"sigma_t": 8.0, "albedo": 1.0}},
    "smooth glass": {"mesh": moved(BALL, 0.6), "interface": {"eta": 1.5}},
    "smooth bubble": {"mesh": moved(BALL, 0.6), "interface": {"eta": 1.0}},
    "white": {"mesh": moved(BALL, 0.6), "surface": "diffuse", "reflectance": 1.0},
}


@pytest.mark.parametrize("eta", [1.0, 1.3])
@pytest.mark.parametrize("inside", INSIDES)
def test_nested_furnace(tmp_path: Path, inside: str, eta: float) -> None:
    """Without absorption the result is 1 − F, whatever is inside."""
    from tests.tracer.mitsuba_reference import under_white_sky

    scene = nested_scene(tmp_path, BALL, SCATTERING, (INSIDES[inside],), eta=eta)
    position, outgoing = from_above(scene.mesh)
    mean, error = under_white_sky(scene, position, outgoing, 1000, 1)
    normal = scene.mesh.face_normals[first_face(scene.mesh, position + 0.1 * outgoing, outgoing)]
    expected = 1.0 - fresnel(float(normal @ outgoing), eta)
    # Emitters are sampled too, so that values have noise; float32 errs by 1e-3.
    assert_agree(mean, np.maximum(error, 2e-4), expected)
    assert (error < 0.02).all()


def fresnel(cosine: float, eta: float) -> float:
    across = np.sqrt(1.0 - (1.0 - cosine**2) / eta**2)
    parallel = (eta * cosine - across) / (eta * cosine + across)
    perpendicular = (cosine - eta * across) / (cosine + eta * across)
    return float(0.5 * (parallel**2 + perpendicular**2))


def test_index_matched_part_of_the_same_medium_changes_nothing(tmp_path: Path) -> None:
    """A medium divided by an index-matched boundary behind a rough surface equals the undivided medium."""
    from tests.tracer.mitsuba_reference import transport

    medium = {"sigma_t": [1.0, 2.0, 3.0], "albedo": [0.9, 0.8, 0.5], "phase_g": 0.3}
    (tmp_path / "cut").mkdir()
    uncut = nested_scene(tmp_path, BALL, medium, eta=1.3, roughness=0.5)
    part = {"mesh": moved(BALL, 0.7), "medium": medium}
    cut = nested_scene(tmp_path / "cut", BALL, medium, (part,), eta=1.3, roughness=0.5)
    position, outgoing = from_above(uncut.mesh)
    for seed, incident in enumerate(unit_directions(2, 5)):
        one = transport(uncut, position, outgoing, incident, 10_000, seed)
        other = transport(cut, position, outgoing, incident, 10_000, seed + 10)
        assert_agree(*one, *other)
