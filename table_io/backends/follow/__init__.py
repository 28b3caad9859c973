"""A controller that plays by itself; we follow it."""
