"""Many models and gaps through one test, by the models alone."""

TABLE = "batch.csv"
