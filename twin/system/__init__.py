"""What everything stands on: terminal, files, versions, process pool, limits."""
