"""Makes pictures coarse and bare, in a third of the time; the conftest names why and for whom.

Python imports this module at the start of each process that has its folder in PYTHONPATH. A process
that does not draw imports nothing for it.
"""

import importlib.util
import sys
from importlib.machinery import ModuleSpec
from types import ModuleType
from typing import Any

COARSE: dict[Any, Any] = {
    "savefig.dpi": 30,
    "figure.constrained_layout.use": False,
    "axes.grid": False,
    "xtick.bottom": False,
    "ytick.left": False,
    "ytick.labelleft": False,
}


class DraftFinder:
    """Lets `twin.drawing.pictures` keep its own parameters apart, and draw with coarse ones."""

    def find_spec(self, name: str, path: Any = None, target: Any = None) -> ModuleSpec | None:
        if name != "twin.drawing.pictures":
            return None
        sys.meta_path.remove(self)
        spec = importlib.util.find_spec(name)
        assert spec is not None
        assert spec.loader is not None
        execute = spec.loader.exec_module

        def execute_as_draft(module: ModuleType) -> None:
            execute(module)
            module.FULL_RC_PARAMS = dict(module.RC_PARAMS)  # type: ignore[attr-defined]
            module.RC_PARAMS.update(COARSE)

        spec.loader.exec_module = execute_as_draft  # type: ignore[method-assign]
        return spec


sys.meta_path.insert(0, DraftFinder())
