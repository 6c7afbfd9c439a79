"""Pictures of baked assets: reconstruction between view bins, suns, surface reflection, errors. Never loads torch.

`frames` draws an asset many times, in real time. May import: `prt_bake.reflection`, `prt_bake.lights` and the rooms
below. Begin with `picture.py` (a picture) and `vertices.py` (radiance at vertices). This file imports nothing, so that
`reconstruction` loads without the rest.
"""
