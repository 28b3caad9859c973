"""Processes, supervisor, report, command line."""
