"""A force law, once: place, parameters with units and bounds, force and rates as expressions."""
