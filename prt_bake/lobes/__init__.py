"""Lobes of an asset: spherical Gaussians for what its transport holds beyond the harmonics.

`fit` finds them in values of Ŝ, `interpolation` gives those of a view, `light` is what they are lit by, and `rounding`
makes their files smaller. Their file is described in `formats.asset.lobes`; a bake finds them with
`prt_bake.baking.lobes`.
May import: `formats`, `prt_bake.lights`, `prt_bake.mathematics` and `prt_bake.jit`. Begin with `gaussians.py`.
"""
