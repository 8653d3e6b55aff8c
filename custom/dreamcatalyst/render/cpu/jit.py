"""How the kernels of this folder are compiled and where the compiled code is kept."""

from __future__ import annotations

import hashlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numba
from numba.core.caching import FunctionCache, IndexDataCacheFile

from ... import plugin

_FOLDER = Path(__file__).parent
_SOURCES = [*sorted(_FOLDER.glob("*.py")), _FOLDER.parent / "thresholds.py", _FOLDER.parent / "sh.py"]
_DIGEST = hashlib.sha256(b"".join(path.read_bytes() for path in _SOURCES)).hexdigest()[:16]
_CONFIG: Any = numba.config  # its names are made at run time
_CACHE = Path(_CONFIG.CACHE_DIR or _FOLDER / "__pycache__") / f"kernels-{_DIGEST}"


class Cache(FunctionCache):
    """numba's cache of one function, which a damaged file does not stop, and which is valid wherever the file stands:
    numba's own goes by its path and time, and a link to this package, or a copy, would compile everything anew."""

    def __init__(self, function: Callable):
        super().__init__(function)
        if Path(self._cache_path).is_relative_to(_CACHE):  # and not where numba looks when that cannot be written to
            self._cache_path = str(_CACHE)
            self._cache_file = IndexDataCacheFile(self._cache_path, self._impl.filename_base, _DIGEST)

    def load_overload(self, sig: Any, target_context: Any) -> Any:
        """The compiled function for a signature; None, and so compiled anew, where there is none that can be read."""
        try:
            return super().load_overload(sig, target_context)
        except Exception as error:  # unpickling what was cut off raises any kind
            reason = f"{type(error).__name__}: {error}".splitlines()[0]
            plugin.warn(f"{self._cache_path}: a compiled kernel is damaged ({reason}) and is compiled anew")
            self.flush()
            return None


def kernel(**options: Any) -> Callable[[Callable], Any]:
    """`numba.njit(**options)` with a cache on disk that is valid for these very sources.

    numba looks only at the file in which a function stands; constants and functions that it takes from another file
    would stay as they were when it was compiled. The folder's name is therefore a digest of all files that kernels
    take from.
    """

    def decorate(function: Callable) -> Any:
        before, _CONFIG.CACHE_DIR = _CONFIG.CACHE_DIR, str(_CACHE)
        try:
            made: Any = numba.njit(error_model="numpy", **options)(function)
            made._cache = Cache(function)  # what `cache=True` does, with a cache of ours
            return made
        finally:
            _CONFIG.CACHE_DIR = before

    return decorate
