"""What several commands share: options, progress, messages after a run.

May import: everything but the commands. Begin with `options.py`.
"""
