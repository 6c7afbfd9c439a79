"""What several commands share: options, progress bars, cameras, bounds on figures, the steps after a training.

May import: every room but the commands. Start at `options.py`.
"""
