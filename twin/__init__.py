"""Digital twin of the specimen: predicts, compares, identifies, records, streams."""

import table_io  # noqa: F401  sets the folder of compiled kernels before numba is imported
