"""The rig: drives the shaking table and acquires the sensors. It never imports `twin`."""

import os
import sys

from platformdirs import user_cache_path

# Compiled kernels go to the user's cache folder, not into the package or the working folder; numba
# reads this when it is imported, and child processes inherit it.
os.environ.setdefault("NUMBA_CACHE_DIR", str(user_cache_path("shaketwin") / "kernels"))
if "numba" in sys.modules:  # it has read its settings
    sys.modules["numba"].config.reload_config()
