"""AgX, the tone map of Blender: bright light turns white gradually, where clipping shifts its hue.

This is AgX in Rec.2020 as Filament and three.js have it: Troy Sobotka's AgX (https://github.com/sobotka/AgX), the
matrices of Blender 4 by Eary Chow (https://github.com/EaryChow/AgX_LUT_Gen), and the polynomial of its curve by
Benjamin Wrensch (https://iolite-engine.com/blog_posts/minimal_agx_implementation, mean squared error 4e-6).
"""

from typing import Literal

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
ToneMap = Literal["none", "agx"]

TO_REC2020 = np.linalg.inv(
    [[1.6605, -0.5876, -0.0728], [-0.1246, 1.1329, -0.0083], [-0.0182, -0.1006, 1.1187]]  # ITU-R BT.2407
)
FROM_REC2020 = np.linalg.inv(TO_REC2020)
INSET = np.array(
    [
        [0.856627153315983, 0.0951212405381588, 0.0482516061458583],
        [0.137318972929847, 0.761241990602591, 0.101439036467562],
        [0.11189821299995, 0.0767994186031903, 0.811302368396859],
    ]
)
OUTSET = np.linalg.inv(
    [
        [0.899796955911611, 0.0871996192028351, 0.013003424885555],
        [0.11142098895748, 0.875575586156966, 0.0130034248855548],
        [0.11142098895748, 0.0871996192028349, 0.801379391839686],
    ]
)
LOWEST, HIGHEST = np.log2(0.18) - 10.0, np.log2(0.18) + 6.5
"""log2 of the radiance that becomes black and white: stops about a middle grey of 0.18."""
CURVE = np.array([15.5, -40.14, 31.96, -6.868, 0.4298, 0.1191, -0.00232])
DISPLAY_GAMMA = 2.2


def agx(image: NDArray[np.floating], exposure: float = 0.0, alpha: NDArray[np.floating] | None = None) -> Array:
    """The picture [H,W,3] times 2^exposure as AgX shows it: linear Rec.709 from 0 to 1, for a file in sRGB.

    A picture that is premultiplied by `alpha` [H,W] is premultiplied again.

    >>> agx(np.full((1, 1, 3), 0.18)).round(2).tolist()
    [[[0.21, 0.21, 0.21]]]
    """
    if alpha is not None:
        share = np.asarray(alpha, np.float64)[..., None]
        return np.asarray(agx(image / np.maximum(share, 1e-6), exposure) * share)
    inside = np.maximum(image.astype(np.float64) * 2.0**exposure @ TO_REC2020.T, 0.0) @ INSET.T
    stops = np.log2(np.maximum(inside, 1e-10))
    encoded = np.polyval(CURVE, np.clip((stops - LOWEST) / (HIGHEST - LOWEST), 0.0, 1.0))
    linear = np.maximum(encoded @ OUTSET.T, 0.0) ** DISPLAY_GAMMA
    return np.asarray(np.clip(linear @ FROM_REC2020.T, 0.0, 1.0))
