"""How far apart two pictures are: MSE, SSIM, FLIP, also without their noise, and comparison sheets.

May import: `prt_bake.rendering`, `prt_bake.mathematics` and `formats`. Begin with `metrics.py`.
"""
