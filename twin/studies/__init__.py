"""Studies of the model alone: a test with many models and gaps, and maps over any parameters."""

TABLE_FILE = "batch.csv"
DEFINITION_FILE = "study.json"  # of a map
