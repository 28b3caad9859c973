"""Simplified nonlinear model (SNM) of the rig: parameters, effects and event-exact solvers."""
