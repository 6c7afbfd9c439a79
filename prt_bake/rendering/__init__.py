"""Monte Carlo pictures: of scenes by path tracing, of networks by importance sampling.

May import: `prt_bake.importance`, `prt_bake.network`, `prt_bake.reflection`, `prt_bake.lights`, `prt_bake.tracer` and
the rooms below. Begin with `scene.py` and `network.py`; `loop.py` runs the passes. This file imports nothing, so that
`scene` loads without torch.
"""
