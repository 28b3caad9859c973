"""Reproduction of Stefani, De Angelis, Andreaus: every figure, and a table of comparisons."""
