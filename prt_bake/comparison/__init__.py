"""Comparison of pictures: MSE, SSIM and FLIP, also corrected for noise, and comparison sheets.

May import: `prt_bake.mathematics` and `formats`. Begin with `metrics.py`.
"""

from prt_bake.comparison.metrics import Comparison, compare

__all__ = ["Comparison", "compare"]
