"""Bases of light: how well harmonics, wavelets, Gaussians and learned functions represent a transport.

May import: every room but `cli`, `paper`, `inspection`, `preview` and `shipped`. Begin with `report.py`.
"""
