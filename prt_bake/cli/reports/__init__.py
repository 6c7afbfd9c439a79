"""The commands `prtbake report bake|training|paper`.

May import: everything but the other commands.
"""
