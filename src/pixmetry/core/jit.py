"""Compiled kernels: a lazy proxy around Numba.

``@jit`` costs nothing at import: Numba is imported and the function compiled (or loaded from the cache on disk) at the first call.
A kernel is scalar code over C-contiguous arrays, releases the GIL and starts no threads. Inside the package it lives in a file
named ``_kernels.py`` or ``_*_kernels.py``, together with every constant that it uses.

Numba's cache on disk compares only the file of the function itself, so it would serve a stale result after an edit in a kernel that
is called from another file. Here the cache folder is named by a hash of all kernel sources, so an edit in any of them makes a new one.
"""

from __future__ import annotations

import hashlib
import os
import re
import shutil
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterable
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np

from pixmetry.core.compiling import note_compiling

PACKAGE_ROOT = Path(__file__).resolve().parents[1]
KERNEL_FILE = re.compile(r"_(.+_)?kernels\.py")
DEFAULTS = {"nogil": True, "cache": True, "fastmath": False, "error_model": "numpy"}
KEEP_DAYS = 30

_lock = threading.RLock()
_loaded: dict[str, tuple[int, int] | None] = {}  # kernel file -> its stamp when it was imported


class Kernel:
    """A function that Numba compiles at its first call. Made by :func:`jit`."""

    def __init__(self, function: Callable[..., Any], options: dict[str, Any]) -> None:
        self.py_func = function
        self.options = options
        self.__name__, self.__qualname__ = function.__name__, function.__qualname__
        self.__module__, self.__doc__ = function.__module__, function.__doc__
        self.__wrapped__ = function
        self._dispatcher: Any = None
        file = function.__code__.co_filename
        if PACKAGE_ROOT in Path(file).parents and not KERNEL_FILE.fullmatch(Path(file).name):
            raise ValueError(f"{file}: kernel {function.__name__!r} must live in a file named _kernels.py or _*_kernels.py")
        _loaded.setdefault(file, _stamp(file))

    def __repr__(self) -> str:
        return f"<kernel {self.__module__}.{self.__qualname__}>"

    @property
    def dispatcher(self) -> Any:
        """The Numba dispatcher, or the plain function when ``NUMBA_DISABLE_JIT`` is set."""
        if self._dispatcher is None:
            with _lock:
                if self._dispatcher is None:
                    self._dispatcher = _compile(self.py_func, self.options)
        return self._dispatcher

    def __call__(self, *args: Any) -> Any:
        return (self._dispatcher or self.dispatcher)(*[_plain(a) if isinstance(a, np.ndarray) else a for a in args])


def jit(function: Callable[..., Any] | None = None, /, **options: Any) -> Any:
    """Mark a function as a kernel.

    Parameters
    ----------
    function : callable
        Code that Numba compiles in nopython mode. It may call other kernels, also of other files. It must not write to an array
        that is an input: arrays come without their read-only flag, and one that is not C-contiguous comes as a copy.
    **options
        Options of ``numba.njit`` beside or instead of ``nogil=True, cache=True, fastmath=False, error_model="numpy"``.

    Returns
    -------
    Kernel
        A callable with positional arguments.

    Raises
    ------
    ValueError
        If a kernel of this package is not in a file named ``_kernels.py`` or ``_*_kernels.py``.
    """
    if function is None:
        return lambda f: Kernel(f, DEFAULTS | options)
    return Kernel(function, DEFAULTS | options)


class _Writable:
    """Hands the memory of a read-only array to NumPy without the flag, and keeps the array alive."""

    def __init__(self, array: np.ndarray) -> None:
        self.array = array
        interface = array.__array_interface__
        self.__array_interface__ = interface | {"data": (interface["data"][0], False)}


def _plain(array: np.ndarray) -> np.ndarray:
    """Give every array of one dtype and rank the same Numba type: C-contiguous, without the read-only flag."""
    flags = array.flags
    if not flags.c_contiguous:
        return np.ascontiguousarray(array)
    return array if flags.writeable else np.asarray(_Writable(array))


def _compile(function: Callable[..., Any], options: dict[str, Any]) -> Any:
    import numba

    _teach_numba()
    config: Any = numba.config
    folder = _cache_folder(function) if options["cache"] and not config.DISABLE_JIT else None
    if folder is None:
        return numba.njit(**options | {"cache": False})(function)
    before = config.CACHE_DIR  # Numba reads it once, when the dispatcher is made
    try:
        config.CACHE_DIR = str(folder)
        return numba.njit(**options)(function)
    finally:
        config.CACHE_DIR = before


def _teach_numba() -> None:
    """Let Numba see a kernel, wherever compiled code refers to one, as the dispatcher behind it."""
    from numba.core import types
    from numba.extending import typeof_impl

    if Kernel not in typeof_impl.registry:

        @typeof_impl.register(Kernel)
        def _typeof_kernel(value: Kernel, _context: Any) -> Any:
            return types.Dispatcher(value.dispatcher)

        _watch_numba()


def _watch_numba() -> None:
    """Take note of all that Numba compiles, which is nothing where the cache on disk has it."""
    from numba.core import event

    class Watch(event.Listener):
        def on_start(self, event: Any) -> None:
            note_compiling()

        def on_end(self, event: Any) -> None:
            note_compiling()

    event.register("numba:compile", Watch())


def _stamp(file: str) -> tuple[int, int] | None:
    try:
        status = os.stat(file)
    except OSError:
        return None
    return status.st_mtime_ns, status.st_size


def _cache_folder(function: Callable[..., Any]) -> Path | None:
    """Return the folder for the compiled code of a function, or None when its source cannot be trusted to stand still."""
    own = [file for file in _files_reached(function) if PACKAGE_ROOT not in Path(file).parents]
    used = {file: stamp for file, stamp in _loaded.items() if file in own or PACKAGE_ROOT in Path(file).parents}
    if any(stamp is None or _stamp(file) != stamp for file, stamp in used.items()):
        return None  # made interactively, or edited since it was imported: what runs is not what the files say
    root = _cache_root()
    folder = root / _package_hash()
    if not folder.exists():
        _remove_old(root)
    if own:
        neighbours = {path for file in own for path in kernel_files(_top_folder(Path(file)))}
        folder = folder / _hash(sorted(neighbours | {Path(file) for file in own}), "")
    try:
        folder.mkdir(parents=True, exist_ok=True)
        os.utime(root / folder.relative_to(root).parts[0])
    except OSError:
        return None
    return folder


def cache_folder() -> Path | None:
    """Return the folder of the compiled kernels of this package, or None where there is none yet."""
    folder = _cache_root() / _package_hash()
    return folder if folder.is_dir() else None


def _package_hash() -> str:
    return _hash([*kernel_files(PACKAGE_ROOT), Path(__file__)], _platform())


def _files_reached(function: Callable[..., Any]) -> set[str]:
    """Return the files of a function and of every kernel or jitted function that its code refers to, directly or not."""
    files: set[str] = set()
    seen: set[int] = set()
    waiting = [function]
    while waiting:
        current = waiting.pop()
        if id(current) in seen:
            continue
        seen.add(id(current))
        files.add(current.__code__.co_filename)
        waiting += [value.py_func for value in _values_named(current) if hasattr(value, "py_func")]
    return files


def _values_named(function: Callable[..., Any]) -> list[Any]:
    code, names = function.__code__, function.__globals__
    values = [names[name] for name in code.co_names if name in names]
    values += [cell.cell_contents for cell in function.__closure__ or ()]
    modules = [value for value in values if isinstance(value, ModuleType)]
    return values + [getattr(module, name) for module in modules for name in code.co_names if hasattr(module, name)]


def _top_folder(file: Path) -> Path:
    """Return the folder of the outermost package that holds a file, or the file's own folder when it is in no package."""
    folder = file.parent
    while (folder / "__init__.py").exists() and (folder.parent / "__init__.py").exists():
        folder = folder.parent
    return folder


def kernel_files(folder: Path) -> list[Path]:
    """Name the files of kernels in a folder; in a package, also in the folders below it."""
    in_package = (folder / "__init__.py").exists() or folder == PACKAGE_ROOT
    found = folder.rglob("_*kernels.py") if in_package else folder.glob("_*kernels.py")
    return sorted(path for path in found if KERNEL_FILE.fullmatch(path.name))


def _hash(files: Iterable[Path], extra: str) -> str:
    digest = hashlib.blake2b(extra.encode(), digest_size=10)
    for file in files:
        content = file.read_bytes()
        digest.update(f"\0{file.name}\0{len(content)}\0".encode())
        digest.update(content)
    return digest.hexdigest()


def _platform() -> str:
    import numba
    from llvmlite import binding  # type: ignore[import-untyped]

    features = binding.get_host_cpu_features().flatten()
    return "|".join([numba.__version__, np.__version__, sys.version, binding.get_host_cpu_name(), features])


def _cache_root() -> Path:
    """Return the first folder that this user can write to: PIXMETRY_CACHE_DIR, the user's cache, a private temporary folder."""
    asked = os.environ.get("PIXMETRY_CACHE_DIR")
    user = Path(os.environ.get("XDG_CACHE_HOME") or Path("~/.cache").expanduser()) / "pixmetry"
    for folder in ([Path(asked)] if asked else []) + [user]:
        try:
            (folder / "kernels").mkdir(parents=True, exist_ok=True)
        except OSError:
            continue
        if os.access(folder / "kernels", os.W_OK | os.X_OK):
            return folder / "kernels"
    return _temporary_root()


def _temporary_root() -> Path:
    # Cached code is executed, so a folder in a shared place must belong to this user and to nobody else.
    folder = Path(tempfile.gettempdir()) / f"pixmetry-kernels-{getattr(os, 'getuid', int)()}"
    folder.mkdir(mode=0o700, exist_ok=True)
    status = folder.stat()
    if hasattr(os, "getuid") and (status.st_uid != os.getuid() or status.st_mode & 0o022):
        return Path(tempfile.mkdtemp(prefix="pixmetry-kernels-"))
    return folder


def _remove_old(root: Path) -> None:
    """Remove the folders of other sources that no process has opened for a month."""
    oldest = time.time() - KEEP_DAYS * 86400
    for folder in root.iterdir():
        try:
            if re.fullmatch("[0-9a-f]{20}", folder.name) and folder.is_dir() and folder.stat().st_mtime < oldest:
                shutil.rmtree(folder, ignore_errors=True)
        except OSError:  # another process was faster
            continue
