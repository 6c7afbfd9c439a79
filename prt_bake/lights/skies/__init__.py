"""Lat-long sky pictures in their own polar frame, whose +z is up; `lights` turns the results to object space.

`shape` and `pixels` check a picture, `fourier` projects it, `downsampled` shrinks a large one, `sampling` draws
directions from it, `prefiltered` averages it over solid angles, `bright_sources` finds suns. May import:
`prt_bake.mathematics`, `prt_bake.jit`, `bakers` and `formats`. Begin with `fourier.py`. This file imports nothing, so
that a picture is read without numba.
"""
