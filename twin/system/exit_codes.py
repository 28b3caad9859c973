"""Exit codes of commands beside 0; their meaning to users is in the guide's page of messages."""

EXIT_FAILED, EXIT_ABORTED, EXIT_GAPS, EXIT_NOT_IDENTICAL, EXIT_INTERRUPTED = 2, 3, 4, 5, 130
