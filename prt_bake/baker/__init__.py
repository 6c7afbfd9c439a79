"""What a bake is made of, whatever way it goes about it: what it is asked for and needs, where its numbers go, who does
it, and what it is likely to take. `prt_bake.baking` is its verb, `prt_bake.to_error` the way that aims at an error.
"""
