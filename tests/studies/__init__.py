"""Long studies of the product, each run as a module; one thread for matrices, as in a run."""

from twin.system.resource_limits import limit_matrix_threads

limit_matrix_threads()
