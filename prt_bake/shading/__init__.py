"""Pictures of baked assets: reconstruction between view bins, suns, surface reflection, errors. Never loads torch.

`frames` draws an asset many times. May import: `prt_bake.reflection` and the rooms below it in `pyproject.toml`. Begin
with `picture.py` (a picture) and `vertices.py` (radiance at vertices). Names load when they are used.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach(
    __name__,
    submod_attrs={
        "picture": ["Picture", "render_picture"],
        "sun_shading": ["SunsApart", "suns_apart"],
        "vertices": ["shade"],
    },
)
