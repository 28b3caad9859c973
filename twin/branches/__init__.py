"""Branches of periodic motions, their bifurcations and basins, as a page."""
