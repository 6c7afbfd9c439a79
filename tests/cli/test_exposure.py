"""Objects that clip, and dark ones, are remarked with the exposure that shows them."""

import numpy as np
import pytest

from prt_bake.cli.shared.exposure import exposure_remark

SEEN = np.repeat([1.0, 0.5, 0.0], 40)[:, None]


def picture(object_: float, others: float = 9.0) -> np.ndarray:
    """Radiance [120,1,3]: of the object, its edges and the sky."""
    red_only = [[1.0, 0.1, 0.1]]
    return np.where(SEEN[..., None] == 1.0, object_, others) * red_only


@pytest.mark.parametrize("exposure", [0.0, -1.0])
def test_the_exposure_shows_an_object_that_clips(exposure: float) -> None:
    remark = exposure_remark(picture(5.0), SEEN, exposure)
    assert (
        remark
        == "100% of the object is brighter than white and is clipped; --exposure -2.5 shows it, or --tone-map agx"
    )
    assert exposure_remark(picture(5.0), SEEN, -2.5) is None


def test_the_exposure_brightens_a_dark_object() -> None:
    assert exposure_remark(picture(0.02), SEEN) == "the object is dark; --exposure 5.5 brightens it"
    assert exposure_remark(picture(0.02), SEEN, 5.5) is None


def test_other_objects_have_no_remark() -> None:
    assert exposure_remark(picture(0.7), SEEN) is None
    assert exposure_remark(picture(0.0), SEEN) is None
    assert exposure_remark(picture(5.0), np.zeros_like(SEEN)) is None
    few = picture(0.7)
    few[:2] = 3.0
    assert exposure_remark(few, SEEN) is None
