"""Wiring tables of a rig file: one module per kind of hardware, config models only."""
