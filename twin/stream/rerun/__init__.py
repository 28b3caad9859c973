"""Rerun with the project's layout: blocks and records as moving pictures."""
