"""What the rig should do: parameters, effects, exact solver."""
