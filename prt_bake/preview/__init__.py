"""The preview window: an asset under any light, seen from any camera, drawn by VTK.

`state.py` computes what is shown without a window; `view.py` draws it; `window.py` handles the user's input. Nothing is
re-exported: VTK loads only when a window opens.

May import: `prt_bake.shading` and the rooms below it in `pyproject.toml`. Start at `state.py`.
"""
