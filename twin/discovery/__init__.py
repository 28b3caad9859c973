"""Identification of parameters and missing effects from recorded tests."""
