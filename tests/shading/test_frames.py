"""Frames: they equal the slow reference for all views, and culled vertices are invisible."""

import dataclasses
import math
import subprocess
import sys
import tracemalloc

import numpy as np
import pytest

from formats.asset import Asset, read_asset, write_asset
from formats.errors import QueryError
from formats.mesh import Mesh
from prt_bake.baking.compress import compress, unpacked
from prt_bake.jit import vectors
from prt_bake.lights import environment
from prt_bake.mathematics import sphere
from prt_bake.shading.frames.frames import Frames
from prt_bake.shading.picture import shade, shade_vertices
from tests.baking.test_compress import asset_with, of_rank
from tests.shading import reference
from tests.shading.test_picture import make_asset, make_light
from tests.shapes import ball, ring

EYE = np.array([1.0, 2.0, 9.0])


def frames_of(asset: Asset, light=None, folded=False) -> Frames:
    frames = Frames(asset)
    if asset.quantity == "transfer":
        frames.light(make_light(asset.degree) if light is None else light)
    if folded:
        frames.fold()
    return frames


def random_asset(mesh: Mesh, rings=4, sectors=6, storage="float32", **others) -> Asset:
    """Independent random coefficients of both signs."""
    asset = make_asset(mesh, rings, sectors, storage=storage, **others)
    noise = np.random.default_rng(7).normal(size=asset.coefficients.shape)
    return dataclasses.replace(asset, coefficients=noise.astype(storage))


def looking(local: np.ndarray, rings: int, sectors: int, storage="float32") -> Asset:
    """Vertices at the origin whose frames see the eye at (0, 0, 4) in the directions `local` [V,3]."""
    count = len(local)
    rng = np.random.default_rng(3)
    turned = sphere.random_rotations(count, seed=5)
    towards = np.array([0.0, 0.0, 1.0])
    normals, tangents = np.empty((2, count, 3))
    for v in range(count):
        # Two frames: the first axis is `local`, in local coordinates, or the direction of the eye.
        inside = np.linalg.qr(np.stack([local[v], *rng.normal(size=(2, 3))], axis=1))[0]
        outside = np.linalg.qr(np.stack([towards, *turned[v][:2]], axis=1))[0]
        inside, outside = (
            axes * np.sign(axes[:, 0] @ first) for axes, first in ((inside, local[v]), (outside, towards))
        )
        rotation = outside @ inside.T
        rotation = rotation if np.linalg.det(rotation) > 0 else outside @ np.diag([1.0, 1.0, -1.0]) @ inside.T
        # Rounded as in a file.
        tangents[v], normals[v] = rotation[:, 0].astype(np.float32), rotation[:, 2].astype(np.float32)
    mesh = Mesh(np.zeros((count, 3)), np.zeros((0, 3), np.int64), normals)
    return dataclasses.replace(random_asset(mesh, rings, sectors, storage), tangents=tangents)


def assert_reference(asset: Asset, frames: Frames, eye=EYE, tolerance=1e-6, light=None) -> None:
    light = make_light(asset.degree) if light is None else light
    exact = unpacked(asset) if not isinstance(asset.coefficients, np.ndarray) else asset
    expected = reference.reconstruct(exact, light, np.asarray(eye))
    for held in (False, True):
        if held:
            frames.hold(eye)
        drawn = frames.draw(eye)
        np.testing.assert_allclose(drawn, np.maximum(expected, 0.0), rtol=0, atol=tolerance * abs(expected).max())
        assert drawn.any()


@pytest.mark.parametrize("folded", [False, True])
@pytest.mark.parametrize("storage", ["float32", "float16"])
@pytest.mark.parametrize(
    "asset",
    [
        {"rings": 16, "sectors": 64},
        {"rings": 4, "sectors": 6, "valid": np.arange(66) % 5 > 1},
        {"rings": 1, "sectors": 1},
        {"rings": 1, "sectors": 5},
        {"rings": 5, "sectors": 1},
        {"views": 1},
        {"channels": 1},
        {"views": 1, "channels": 1, "degree": 0},
        {"degree": 1},
        {"degree": 8},
    ],
    ids=str,
)
def test_a_frame_equals_the_slow_reference(asset, storage, folded) -> None:
    made = random_asset(ball(2), storage=storage, **asset)
    assert_reference(made, frames_of(made, folded=folded))


@pytest.mark.parametrize("folded", [False, True])
@pytest.mark.parametrize("cos_theta", [1.0, 1 - 1e-12, 1 - 1e-7, 1 - 0.5 / 16, 0.5 / 16, 1e-3, 0.0, -0.3, -1.0])
def test_pole_seam_grazing_and_below_the_horizon_equal_the_reference(cos_theta, folded) -> None:
    phi = np.concatenate([np.linspace(-1e-3, 1e-3, 9), np.linspace(-math.pi, math.pi, 9), [1e-12, -1e-12]])
    sin_theta = math.sqrt(1 - cos_theta**2)
    local = np.stack([sin_theta * np.cos(phi), sin_theta * np.sin(phi), np.full(len(phi), cos_theta)], axis=1)
    asset = looking(local, 16, 64)
    assert_reference(asset, frames_of(asset, folded=folded), (0.0, 0.0, 4.0))


def test_the_frames_of_looking_have_the_requested_directions() -> None:
    local = sphere.uniform(20, 1)
    asset = looking(local, 4, 6)
    again = sphere.to_local(np.array([0.0, 0.0, 1.0]), asset.mesh.normals, asset.tangents)
    np.testing.assert_allclose(again, local, atol=1e-7)


@pytest.mark.parametrize("variant", ["learned", "views left out", "channels left out", "few functions", "factorised"])
@pytest.mark.parametrize("folded", [False, True])
def test_compact_assets_are_drawn_like_their_decoded_form(variant, folded) -> None:
    made = {
        "learned": lambda: asset_with(of_rank(6, 0.01) + 20.0),
        "views left out": lambda: asset_with(of_rank(3, 0.01, bins=1)),
        "channels left out": lambda: asset_with(of_rank(3, 0.01, channels=1)),
        "few functions": lambda: asset_with(of_rank(1, 0.0)),
        "factorised": lambda: make_asset(ball(2), 4, 16),
    }[variant]()
    compact = compress(made, 0.005)
    assert_reference(compact, frames_of(compact, folded=folded), tolerance=2e-6)


@pytest.mark.parametrize("native", [True, False])
def test_conversion_of_float16_is_exact(monkeypatch, native) -> None:
    """For all finite numbers, subnormal ones too, with and without the processor's instruction."""
    monkeypatch.setattr(vectors, "_processor_widens", lambda own=vectors._processor_widens: native and own())
    every = np.arange(65536, dtype=np.uint16)
    every = every[np.isfinite(every.view(np.float16))]
    np.testing.assert_array_equal(_widened_sums(every), every.view(np.float16).astype(np.float32))


def _widened_sums(bits: np.ndarray) -> np.ndarray:
    """Each number converted alone, in rows of 16."""
    from numba import njit

    lit = vectors._lit_rows(16)

    @njit
    def one_by_one(bits, lights, out):
        for i in range(bits.shape[0]):
            row = i - i % 16
            out[i] = lit(bits, 16, row, row, row, row, *ONLY_FIRST, lights[i % 16])[0]

    lights = np.zeros((16, 1, 3, 16), np.float32)
    lights[np.arange(16), 0, 0, np.arange(16)] = 1.0
    out = np.empty(len(bits), np.float32)
    one_by_one(bits, lights, out)
    return out


ONLY_FIRST = tuple(np.float32([1.0, 0.0, 0.0, 0.0]))


def test_a_white_furnace_is_invisible() -> None:
    asset = make_asset(ball(2))
    coefficients = np.zeros_like(asset.coefficients)
    coefficients[:, :, 0] = 1 / math.sqrt(4 * math.pi)
    furnace = dataclasses.replace(asset, coefficients=coefficients)
    light = environment.project(np.full((8, 16, 3), 3.0, np.float32))
    for folded in (False, True):
        np.testing.assert_allclose(frames_of(furnace, light, folded).draw(EYE), 3.0, rtol=1e-6)


def test_radiance_is_linear_in_the_light() -> None:
    frames, one, two = Frames(make_asset(ball(2))), make_light(seed=1), make_light(seed=2)

    def under(light: np.ndarray) -> np.ndarray:
        frames.light(light)
        return frames.draw(EYE).astype(np.float64)

    np.testing.assert_allclose(under(0.3 * one + 2.0 * two), 0.3 * under(one) + 2.0 * under(two), rtol=2e-6)
    np.testing.assert_allclose(under(1e5 * one), 1e5 * under(one), rtol=2e-6)


@pytest.mark.parametrize("up", ["y", "z"])
@pytest.mark.parametrize("degree", [0, 2, 4])
def test_a_rotated_light_equals_the_projection_of_the_rotated_sky(up, degree) -> None:
    sky = np.random.default_rng(3).random((16, 32, 3)).astype(np.float32)
    asset = make_asset(ball(2), degree=degree, up=up)
    frames = frames_of(asset, environment.project(sky, degree, up))
    # A roll by 8 of 32 columns is a quarter turn: to the left with y up, where φ runs clockwise seen from above.
    rolled = environment.project(np.roll(sky, -8, axis=1), degree, up)
    before = frames.draw(EYE).copy()
    frames.fold()
    frames.turn(90.0)
    np.testing.assert_allclose(frames.draw(EYE), shade(asset, rolled, EYE), rtol=3e-6)
    assert degree == 0 or abs(frames.draw(EYE) - before).max() > 1e-3
    for degrees in (0.0, 33.0, -750.0):
        frames.turn(degrees)
        turned = environment.rotate_light(environment.project(sky, degree, up), degrees, up)
        np.testing.assert_allclose(frames.draw(EYE), shade(asset, turned, EYE), rtol=3e-6)


@pytest.mark.parametrize("storage", ["float32", "float16"])
def test_a_new_light_undoes_the_fold(storage) -> None:
    asset = make_asset(ball(2), storage=storage)
    frames = frames_of(asset, folded=True)
    frames.light(make_light(seed=9))
    assert_reference(asset, frames, light=make_light(seed=9))
    frames.fold()
    assert_reference(asset, frames, light=make_light(seed=9))


@pytest.mark.parametrize("compact", [False, True])
def test_a_held_view_is_used_under_any_light_and_for_no_other_view(compact) -> None:
    """Held rows are overwritten with huge numbers, which show where they are used."""
    mesh = ring(around=45, across=35) if compact else ring(around=90, across=70)
    count = len(mesh.positions)
    asset = make_asset(mesh, valid=np.arange(count) % 7 > 0)
    asset = compress(asset, 0.05) if compact else asset
    frames, again = frames_of(asset), frames_of(asset)
    some = np.random.default_rng(1).random(count) < 0.7
    frames.hold(EYE, some, cull=True)
    for seed in (1, 2):
        for one in (frames, again):
            one.light(make_light(seed=seed))
        frames.draw(-EYE)
        expected = again.draw(EYE, some, cull=True)
        np.testing.assert_allclose(frames.draw(EYE, some, cull=True), expected, rtol=0, atol=3e-6)
        assert frames.clamped == pytest.approx(again.clamped, rel=1e-5, abs=1e-8)
        np.testing.assert_array_equal(frames.draw(EYE, cull=True) != 0.0, again.draw(EYE, cull=True) != 0.0)
    nothing = np.zeros(count, np.bool_)
    frames.draw(EYE, nothing)
    assert frames.draw(EYE, some, cull=True).any()
    assert not frames.draw(EYE, nothing).any()
    frames.fold()
    frames._held[:] = 1e9
    for eye, visible, cull in ((-EYE, some, True), (EYE, None, True), (EYE, some, False)):
        assert frames.draw(eye, visible, cull=cull).max() < 1e3
    assert frames.draw(EYE, some, cull=True).max() > 1e6


@pytest.mark.parametrize("folded", [False, True])
def test_only_requested_vertices_are_drawn_and_others_are_zero(folded) -> None:
    """With enough vertices for several batches, lanes and threads."""
    mesh = ring(around=90, across=70)
    asset = make_asset(mesh, valid=np.random.default_rng(1).random(6300) < 0.8)
    frames = frames_of(asset, folded=folded)
    whole = frames.draw(EYE).copy()
    np.testing.assert_allclose(whole, shade(asset, make_light(), EYE), rtol=0, atol=3e-6)
    for seed, share in enumerate((0.9, 0.01, 0.5, 0.0, 1.0)):
        visible = np.random.default_rng(seed).random(6300) < share
        drawn = frames.draw(EYE, visible)
        np.testing.assert_array_equal(drawn, np.where(visible[:, None], whole, 0.0))


def test_culled_vertices_are_hidden() -> None:
    """On a closed object no face of a culled vertex faces the eye, and most such vertices are culled."""
    mesh = ring(around=40, across=30)
    frames = frames_of(make_asset(mesh))
    for eye in (EYE, np.array([0.5, 0.9, 1.2]), np.array([0.1, 6.0, 0.0])):
        whole = frames.draw(eye).copy()
        drawn = frames.draw(eye, cull=True)
        culled = ~drawn.any(axis=1)
        np.testing.assert_array_equal(drawn[~culled], whole[~culled])
        towards = eye - mesh.positions[mesh.faces[:, 0]]
        facing = (mesh.face_normals * towards).sum(axis=1) > 0.0
        turned_to = np.zeros(len(mesh.positions), np.bool_)
        turned_to[mesh.faces[facing]] = True
        assert not (culled & turned_to).any()
        assert culled.sum() > 0.7 * (~turned_to).sum() > 100


def test_culling_of_vertices_without_faces_and_with_opposite_faces() -> None:
    positions = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [5, 5, 5]])
    mesh = Mesh(positions, np.array([[0, 1, 2], [0, 2, 1]]), np.tile([0.0, 0.0, 1.0], (4, 1)))
    frames = frames_of(make_asset(mesh))
    for height in (4.0, -4.0):
        drawn = frames.draw([0.1, 0.1, height], cull=True)
        np.testing.assert_array_equal(drawn.any(axis=1), [True, True, True, False])


def test_the_clamped_share_is_reported() -> None:
    asset = random_asset(ball(2))
    frames = frames_of(asset)
    for visible in (None, np.arange(66) < 30):
        frames.draw(EYE, visible)
        assert frames.clamped == pytest.approx(shade_vertices(asset, make_light(), EYE, visible).clamped, rel=1e-5)
    frames.draw(EYE, np.zeros(66, np.bool_))
    assert frames.clamped == 0.0
    positive = dataclasses.replace(asset, coefficients=abs(asset.coefficients))
    frames = frames_of(positive, np.concatenate([-np.ones((1, 3)), np.zeros((8, 3))]))
    assert (frames.draw(EYE).any(), frames.clamped) == (False, 1.0)


def test_a_frame_allocates_nothing() -> None:
    asset = make_asset(ring(around=90, across=70))
    for frames in (frames_of(asset), frames_of(asset, folded=True), frames_of(compress(make_asset(ball(4)), 0.05))):
        visible = np.ones(len(frames.draw(EYE)), np.bool_)
        buffer = frames.draw(EYE, visible)
        tracemalloc.start()
        for k in range(20):
            assert frames.draw(EYE + 0.1 * k, visible) is buffer
        _, most = tracemalloc.get_traced_memory()
        tracemalloc.stop()
        assert most < 4000 < buffer.nbytes
        frames.hold(EYE)
        frames.draw(EYE)
        tracemalloc.start()
        assert frames.draw(EYE) is buffer
        _, most = tracemalloc.get_traced_memory()
        tracemalloc.stop()
        assert most < 4000


def test_an_asset_made_for_one_light_is_drawn() -> None:
    asset = dataclasses.replace(make_asset(ball(2), degree=0), quantity="radiance", degree=2)
    frames = Frames(asset)
    np.testing.assert_allclose(frames.draw(EYE), shade(asset, None, EYE), rtol=1e-6)
    frames.light(None)
    frames.fold()
    np.testing.assert_allclose(frames.draw(EYE), shade(asset, None, EYE), rtol=1e-6)
    frames.hold(EYE)
    np.testing.assert_allclose(frames.draw(EYE), shade(asset, None, EYE), rtol=1e-6)
    with pytest.raises(QueryError, match="cannot be relit"):
        frames.light(make_light())
    with pytest.raises(QueryError, match="cannot be turned"):
        frames.turn(5.0)


def test_an_open_file_is_drawn_like_the_array_in_it(tmp_path) -> None:
    asset = make_asset(ball(2), storage="float16")
    write_asset(asset, tmp_path / "asset.h5")
    with read_asset(tmp_path / "asset.h5", load=False) as opened:
        drawn = frames_of(opened).draw(EYE)
    np.testing.assert_array_equal(drawn, frames_of(read_asset(tmp_path / "asset.h5")).draw(EYE))


@pytest.mark.parametrize(("eye", "far"), [(1e6 * EYE, True), (1e98 * EYE, True), (ball(2).positions[3], False)])
def test_eyes_far_away_and_on_a_vertex_give_finite_radiance(eye, far) -> None:
    asset = make_asset(ball(2))
    drawn = frames_of(asset).draw(eye)
    assert np.isfinite(drawn).all()
    assert (drawn > 0).all()
    if far:
        np.testing.assert_allclose(drawn, shade(asset, make_light(), np.tile(EYE, (66, 1))), rtol=2e-6)


def test_an_object_far_from_the_origin_is_drawn_with_the_same_accuracy() -> None:
    mesh, far = ball(2), np.array([1e6, -3e6, 2e6])
    here, there = make_asset(mesh), make_asset(Mesh(mesh.positions + far, mesh.faces, mesh.normals))
    np.testing.assert_allclose(frames_of(there).draw(EYE + far), frames_of(here).draw(EYE), rtol=2e-6)


@pytest.mark.parametrize(
    ("act", "sentence"),
    [
        (lambda frames: frames.draw(EYE), "none was set"),
        (lambda frames: frames.fold(), "none was set"),
        (lambda frames: frames.turn(3.0), "none was set"),
        (lambda frames: frames.light(np.ones((4, 3))), r"shape \[9, 3\] .*found \[4, 3\]"),
        (lambda frames: frames.light(np.full((9, 3), np.nan)), "not finite"),
        (lambda frames: frames.light(np.full((9, 3), 1e39)), "float32"),
        (lambda frames: frames.turn(math.nan), "a finite number, found nan"),
    ],
)
def test_lights_that_do_not_fit_are_refused(act, sentence) -> None:
    with pytest.raises(QueryError, match=sentence):
        act(Frames(make_asset(ball(2))))


@pytest.mark.parametrize(
    ("eye", "visible", "sentence"),
    [
        ((0, 9), None, "point of three finite"),
        ((0, math.nan, 9), None, "point of three finite"),
        ((0, 0, 1e200), None, "point of three finite"),
        (EYE, np.ones(65, np.bool_), r"\[66\] of bool, found \[65\] of bool"),
        (EYE, np.ones(66), r"\[66\] of bool, found \[66\] of float64"),
        (EYE, [True] * 66, "of bool, found .* of list"),
    ],
)
def test_eyes_and_masks_that_do_not_fit_are_refused(eye, visible, sentence) -> None:
    with pytest.raises(QueryError, match=sentence):
        frames_of(make_asset(ball(2))).draw(eye, visible)


def test_an_asset_without_any_baked_vertex_is_refused() -> None:
    with pytest.raises(QueryError, match="no vertex was baked"):
        Frames(make_asset(ball(2), valid=np.zeros(66, np.bool_)))


def test_frames_load_no_torch() -> None:
    program = "import sys, prt_bake.shading.frames.frames; print('torch' in sys.modules)"
    ran = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, timeout=600, check=False)
    assert (ran.returncode, ran.stdout.strip()) == (0, "False"), ran.stderr
