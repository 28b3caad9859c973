"""The page of a run, and the list and the comparison of runs."""
