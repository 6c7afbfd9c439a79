"""Row coefficients and downsampled copies equal plain sums and sparse matrices, for any blocks, threads and layouts."""

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from scipy.sparse import csr_array

from formats.errors import ImageError
from formats.image import write_image
from formats.image.rows import ImageRows, rows_of
from prt_bake.lights import environment
from prt_bake.lights.skies import downsampled, fourier
from prt_bake.mathematics import sh

KINDS = ["float16", "float32", "float64"]


def painted(height: int, width: int, kind: str = "float64", seed: int = 1) -> np.ndarray:
    return (10 ** np.random.default_rng(seed).uniform(-2, 4, (height, width, 3))).astype(kind)


def layouts(image: np.ndarray) -> dict[str, np.ndarray]:
    """The same pixels in the memory layouts of files and pictures."""
    height, width, _ = image.shape
    store = np.zeros((height, 5 + 3 * width), image.dtype)  # blue, green and red rows, as in files
    backward = store[:, 3 : 3 + 3 * width].reshape(height, 3, width)[:, ::-1].swapaxes(1, 2)
    backward[:] = image
    return {
        "interleaved": image,
        "planes": np.moveaxis(np.ascontiguousarray(np.moveaxis(image, 2, 0)), 0, 2),
        "backward": backward,
        "upside down": image[::-1].copy()[::-1],
        "every other column": np.repeat(image, 2, axis=1)[:, ::2],
        "other byte order": image.astype(image.dtype.newbyteorder()),
    }


def uneven(image: np.ndarray) -> ImageRows:
    """In blocks of 1, 2, 3 … rows."""
    cuts = np.cumsum(range(len(image)))
    return ImageRows("image", *image.shape[:2], lambda: iter(np.split(image, cuts[(cuts > 0) & (cuts < len(image))])))


def shrunk_by_matrices(image: np.ndarray, height: int) -> np.ndarray:
    """The downsampled copy by sparse matrices of overlaps: slow, with the picture in memory."""
    width = max(1, round(image.shape[1] * height / image.shape[0]))
    down, across = (
        shares_of(fine, coarse, measure)
        for fine, coarse, measure in (
            (image.shape[0], height, lambda end, begin: np.cos(np.pi * begin) - np.cos(np.pi * end)),
            (image.shape[1], width, np.subtract),
        )
    )
    return np.stack([down @ image[..., c].astype(np.float64) @ across.T for c in range(3)], axis=-1)


def shares_of(fine: int, coarse: int, measure: object) -> csr_array:
    cuts = np.union1d(np.arange(fine + 1) * coarse, np.arange(coarse + 1) * fine)
    begins, ends = cuts[:-1], cuts[1:]
    size = measure(ends / (fine * coarse), begins / (fine * coarse))
    size /= np.bincount(begins // fine, size)[begins // fine]
    return csr_array((size, (begins // fine, begins // coarse)), (coarse, fine))


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize(
    ("rows", "width", "degree"), [(1, 1, 0), (5, 7, 2), (1, 16, 0), (40, 4099, 1), (6, 1030, 20), (80, 2080, 20)]
)
def test_waves_are_sums_over_columns(kind: str, rows: int, width: int, degree: int) -> None:
    """For one strip of columns and for several, the last of them short."""
    image, azimuth = painted(rows, width, kind), fourier.azimuth_integrals(width, degree)
    expected = np.einsum("rwc,mw->rcm", image.astype(np.float64), azimuth)
    scale = 1e-15 * np.abs(image.astype(np.float64)).sum() * np.abs(azimuth).max()
    for name, block in layouts(image).items():
        found = fourier.row_waves(ImageRows(name, rows, width, lambda block=block: iter([block])), degree)
        np.testing.assert_allclose(found, expected, rtol=0, atol=scale, err_msg=name)


def test_integers_are_not_rescaled() -> None:
    integers = np.random.default_rng(2).integers(0, 60000, (6, 8, 3)).astype(np.uint16)
    np.testing.assert_array_equal(environment.project(integers), environment.project(integers.astype(np.float64)))


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("width", [70, 1056])
def test_threads_change_no_bit_and_blocks_only_rounding(monkeypatch: pytest.MonkeyPatch, width: int, kind: str) -> None:
    image = painted(90, width, kind)

    def sums(threads: int, rows: ImageRows) -> list[np.ndarray]:
        monkeypatch.setattr(fourier, "THREADS", threads)
        copies = [downsampled.shrink(rows, height, 3) for height in (1, 7, 60)]
        return [environment.project(rows, 3), *(part for copy in copies for part in copy)]

    expected = sums(1, rows_of(image, rows=90))
    for rows in (rows_of(image, rows=1), uneven(image)):
        one, several = sums(1, rows), sums(3, rows)
        for found, same, whole in zip(one, several, expected, strict=True):
            np.testing.assert_array_equal(found, same)
            tolerance = 1e-7 if whole.dtype == np.float32 else 0.0
            np.testing.assert_allclose(found, whole, rtol=tolerance, atol=1e-12 * np.abs(expected[0]).max())


@pytest.mark.parametrize(
    ("shape", "height"),
    [
        ((64, 128), 23), ((31, 50), 30), ((50, 9), 1), ((7, 9), 7), ((40, 2080), 13), ((33, 1056), 25), ((30, 48), 7),
        ((9, 1072), 1), ((50, 16), 1), ((12, 32), 12),
    ],
)  # fmt: skip
def test_copies_equal_those_by_sparse_matrices(shape: tuple[int, int], height: int) -> None:
    image = painted(*shape, "float32")
    expected = shrunk_by_matrices(image, height)
    for rows in (rows_of(image, rows=5), rows_of(image)):
        copy, residual = downsampled.shrink(rows, height, 4)
        np.testing.assert_allclose(copy, expected, rtol=1e-7)
        whole = environment.project(image, 4)
        lost = whole - environment.project(copy, 4)
        to_object = sh.rotation(environment.from_polar("y"), 4)
        np.testing.assert_allclose(to_object @ residual, lost, rtol=0, atol=1e-13 * np.abs(whole).max())


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
def test_pixels_that_are_not_finite_are_refused_with_their_position(kind: str, value: float) -> None:
    """One channel is enough, and so are two infinities that cancel."""
    image = painted(40, 16, kind)
    image[33, 5, 1] = value
    image[35, 1, 2], image[35, 5, 2] = value, -value
    with pytest.raises(ImageError, match=r"found 3 of 640 pixels .* row 33, column 5"):
        environment.project(rows_of(image, rows=8))
    with pytest.raises(ImageError, match=r"found 3 of 640 pixels .* row 33, column 5"):
        downsampled.shrink(rows_of(image, rows=8), 11, 2)


def test_projecting_a_sky_does_not_import_numba(tmp_path: Path) -> None:
    write_image(tmp_path / "sky.exr", painted(8, 16))
    program = (
        "import sys\nfrom prt_bake.cli.main import main\n"
        f"assert main(['light', {str(tmp_path / 'sky.exr')!r}]) == 0\n"
        "print('numba' in sys.modules, file=sys.stderr)"
    )
    run = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)
    assert run.stderr.split() == ["False"]
