"""A target that speaks our UDP packets."""
