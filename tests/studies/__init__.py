"""Long studies of the product, each run as a module; one thread for matrices, as in a run."""

import os

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
