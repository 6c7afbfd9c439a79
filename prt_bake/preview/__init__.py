"""The preview: an asset under any light, seen from any camera, drawn by PyVista; and assets as meshes for PyVista.

`state.py` computes what is shown without a window; `view.py` draws it with a plotter; `window.py` handles the user's
input; `polydata.py`, `show.py` and `notebook.py` are for Python. Nothing is re-exported: PyVista loads when it is
needed.

May import: `prt_bake.shading` and the rooms below it in `pyproject.toml`. Start at `state.py`.
"""
