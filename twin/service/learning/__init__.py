"""`identify` and `discover` on files: recordings in, models, verdicts, figures and pages out."""
