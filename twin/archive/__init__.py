"""The archive of a laboratory: its catalogue, notes on its runs, and tasks over many of them."""
