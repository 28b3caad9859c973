"""Before anything is imported: one thread for matrices, as in a run."""

import os

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
