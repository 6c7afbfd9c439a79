"""Light that the surface itself reflects: GGX microfacets, sampled by Monte Carlo. Never loads torch.

May import: `prt_bake.lights`, `prt_bake.geometry`, `prt_bake.mathematics` and `formats`. Begin with `reflector.py`.
"""
