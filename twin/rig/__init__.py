"""Commands of the rig: pre-flight, wiring, calibration, devices, simulated tables."""
