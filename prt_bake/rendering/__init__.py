"""Monte Carlo pictures: of scenes by path tracing, of networks by importance sampling.

May import: `prt_bake.importance`, `prt_bake.reflection` and the rooms below these in `pyproject.toml`. Begin with
`scene.py` and `network.py`; `loop.py` runs the passes. Names load when they are used, so that `scene` loads without
torch.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach(
    __name__,
    submod_attrs={
        "network": ["render_network"],
        "scene": ["render_scene"],
    },
)
