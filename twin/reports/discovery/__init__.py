"""Files of `identify` and `discover`: load recordings, write models, verdicts and reports."""
