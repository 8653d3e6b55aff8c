"""What threestudio imports where this repository itself was cloned into its custom/ folder, under whatever name.

The extension then is `custom/dreamcatalyst` in here. It is loaded by its own name, as it is where it was linked: the
folder's may hold dots, which relative imports cannot. Alone nothing imports this file but test runners, and then it
does nothing.
"""

import importlib.util
import sys
from pathlib import Path


def _load(name: str = "dreamcatalyst") -> None:
    file = Path(__file__).parent / "custom" / name / "__init__.py"
    spec = importlib.util.spec_from_file_location(name, file, submodule_search_locations=[str(file.parent)])
    sys.modules[name] = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(sys.modules[name])


if "threestudio" in sys.modules:
    _load()
