"""Lobes of an asset, found in its transport: what lies beyond the harmonics.

`search` fits them at vertices, `pilot` tries at a few vertices how many pay, and `stage` finds those of a whole bake.
May import: `bakers`, `formats`, `prt_bake.baking.job`, `prt_bake.baking.output`, `prt_bake.lobes`, and what these may
import. Begin with `search.py`.
"""
