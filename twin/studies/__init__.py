"""Batch simulation of one test with many models and gaps."""

TABLE_FILE = "batch.csv"
