"""The model side of Stefani, De Angelis, Andreaus: every figure, and a table of what agrees."""
