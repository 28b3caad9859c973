"""Nonlinear dynamics of the model: periodic orbits, their branches and bifurcations."""
