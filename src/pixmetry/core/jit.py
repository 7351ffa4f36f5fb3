"""Compiled kernels: a lazy proxy around Numba.

``@jit`` costs nothing at import: Numba is imported and the function compiled (or loaded from the cache on disk) at the first call.
A kernel is scalar code over C-contiguous arrays, releases the GIL and starts no threads. Inside the package it lives in a file
named ``_kernels.py`` or ``_*_kernels.py``, together with every constant that it uses.

Numba's cache on disk compares only the file of the function itself, so it would serve a stale result after an edit in a kernel that
is called from another file. Here the folder of a kernel is named by a hash of its own file and of the kernel files that this one imports,
directly or not. An edit compiles again what depends on it, and no more; two checkouts share what is alike in both.
"""

from __future__ import annotations

import ast
import hashlib
import importlib.util
import os
import pickle
import re
import shutil
import sys
import tempfile
import threading
import time
import warnings
from collections.abc import Callable, Iterator
from functools import cache, lru_cache
from pathlib import Path
from types import ModuleType
from typing import Any, Generic, ParamSpec, TypeVar, overload

import numpy as np

from pixmetry.core.compiling import note_compiling

PACKAGE_ROOT = Path(__file__).resolve().parents[1]
KERNEL_FILE = re.compile(r"_(.+_)?kernels\.py")
DEFAULTS = {"nogil": True, "cache": True, "fastmath": False, "error_model": "numpy"}
KEEP_DAYS = 30
P = ParamSpec("P")
R = TypeVar("R")
BLOCKS = ("body", "orelse", "handlers", "finalbody", "cases")  # where a statement of Python holds others


def _stamp(file: str) -> tuple[int, int] | None:
    try:
        status = os.stat(file)
    except OSError:
        return None
    return status.st_mtime_ns, status.st_size


_lock = threading.RLock()
_begun_ns = time.time_ns()
_loaded = {__file__: _stamp(__file__)}  # this file and those of kernels -> their stamps when they were imported


class Kernel(Generic[P, R]):
    """A function that Numba compiles at its first call. Made by :func:`jit`; called as that function is."""

    def __init__(self, function: Callable[P, R], options: dict[str, Any]) -> None:
        self.py_func: Callable[..., Any] = function  # numbers or arrays: plain Python does not mind
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

    def __reduce__(self) -> str:
        return self.__qualname__  # pickled by its name: the code that is compiled for a kernel which encloses it is known by this

    @property
    def dispatcher(self) -> Any:
        """The Numba dispatcher, or the plain function when ``NUMBA_DISABLE_JIT`` is set."""
        if self._dispatcher is None:
            with _lock:
                if self._dispatcher is None:
                    self._dispatcher = _compile(self.py_func, self.options)
        return self._dispatcher

    def __call__(self, *args: P.args, **named: P.kwargs) -> R:
        plain = args if _is_plain(args) else [_plain(value) for value in args]
        result: R = (self._dispatcher or self.dispatcher)(*plain, **{name: _plain(value) for name, value in named.items()})
        return result


@overload
def jit(function: Callable[P, R], /, **options: Any) -> Kernel[P, R]: ...


@overload
def jit(**options: Any) -> Callable[[Callable[P, R]], Kernel[P, R]]: ...


def jit(function: Callable[..., Any] | None = None, /, **options: Any) -> Any:
    """Mark a function as a kernel.

    Parameters
    ----------
    function : callable
        Code that Numba compiles in nopython mode. It may call other kernels, also of other files. It must not write to an array
        that is an input: arrays come without their read-only flag, and one that is not C-contiguous comes as a copy; so do those in
        (named) tuples.
    **options
        Options of ``numba.njit`` beside or instead of ``nogil=True, cache=True, fastmath=False, error_model="numpy"``.

    Returns
    -------
    Kernel
        A callable with the arguments of the function.

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


def _is_plain(value: tuple[Any, ...]) -> bool:
    """Whether all arrays in a tuple, and in those in it, are as they are wanted; asked at every call, so it is to be quick."""
    for member in value:
        if isinstance(member, np.ndarray):
            if not member.flags.carray:
                return False
        elif isinstance(member, tuple) and not _is_plain(member):
            return False
    return True


def _plain(value: Any) -> Any:
    """Give every array of one dtype and rank the same Numba type, also within tuples: C-contiguous, without the read-only flag."""
    if isinstance(value, tuple):
        if _is_plain(value):
            return value
        members = [_plain(member) for member in value]
        return type(value)(*members) if hasattr(value, "_fields") else tuple(members)
    if not isinstance(value, np.ndarray):
        return value
    flags = value.flags
    if not flags.c_contiguous:
        return np.ascontiguousarray(value)
    return value if flags.writeable else np.asarray(_Writable(value))


def _compile(function: Callable[..., Any], options: dict[str, Any]) -> Any:
    import numba
    from numba.core.types import unliteral

    _teach_numba()
    config: Any = numba.config
    dispatcher = numba.njit(**options | {"cache": False})(function)
    if config.DISABLE_JIT:
        return dispatcher
    folder = _cache_folder(function) if options["cache"] else None
    if folder is not None:
        dispatcher._cache = _Store(function, folder)
    template = dispatcher.get_call_template
    # where a kernel calls another with constants, Numba would compile that one for each of them
    dispatcher.get_call_template = lambda args, named: template(
        [unliteral(kind) for kind in args], {name: unliteral(kind) for name, kind in named.items()}
    )
    return dispatcher


class _Store:
    """The compiled code of one kernel on disk, in the place of Numba's own cache: one file for each tuple of argument types.

    Numba's cache names its folder by the path of the source, and leads through an index to numbered files: of two processes that
    compile one kernel for different types at once, one can lose its entry or find the code of the other behind its own.
    """

    def __init__(self, function: Callable[..., Any], folder: Path) -> None:
        self.function, self.folder = function, folder
        self.cache_path = str(folder)

    def load_overload(self, signature: Any, context: Any) -> Any:
        """Return the compiled code for a signature, or None where there is none, or none that can be read."""
        from numba.core.compiler import CompileResult
        from numba.core.runtime import rtsys

        rtsys.initialize(context)  # all that runs; what compiling needs besides is loaded, for a quarter of a second, by who compiles
        key = self._key(signature, context.codegen())
        if key is None:
            return None
        try:
            kept_key, parts = pickle.loads(self._file(key).read_bytes())
        except (OSError, EOFError, pickle.UnpicklingError, ValueError):
            return None
        return CompileResult._rebuild(context, *parts) if kept_key == key else None

    def save_overload(self, signature: Any, compiled: Any) -> None:
        """Keep compiled code; where the disk does not take it, it lasts as long as the process."""
        from numba.core.serialize import dumps

        if compiled.lifted or compiled.library.has_dynamic_globals:
            name = self.function.__qualname__
            warnings.warn(f"kernel {name!r} cannot be kept on disk: it holds a pointer or a large global array", stacklevel=2)
            return
        key = self._key(signature, compiled.codegen)
        if key is None:
            return
        file = self._file(key)
        part = file.with_name(f"{file.name}.{os.getpid()}-{threading.get_ident()}.part")
        try:
            part.write_bytes(dumps((key, compiled._reduce())))
            os.replace(part, file)
        except OSError:
            part.unlink(missing_ok=True)

    def flush(self) -> None:
        """Remove the stored code of this kernel; Numba calls it before it compiles again."""
        for file in self.folder.glob(f"{self.function.__name__}-*.nbc"):
            file.unlink(missing_ok=True)

    def _key(self, signature: Any, codegen: Any) -> str | None:
        """Name everything besides the sources that the compiled code depends on; None if an argument is a function, which has no name."""
        from numba.core.serialize import dumps
        from numba.core.sigutils import normalize_signature

        arguments, result = normalize_signature(signature)
        kinds = [_words_of(kind) for kind in (*arguments, result)]
        if any(" at 0x" in words for words in kinds):
            return None
        code = self.function.__code__
        cells = tuple(cell.cell_contents for cell in self.function.__closure__ or ())
        parts = (code.co_firstlineno, *kinds, codegen.magic_tuple(), code.co_code, dumps(cells) if cells else b"")
        return "\0".join(map(str, (self.function.__module__, self.function.__qualname__, *parts)))

    def _file(self, key: str) -> Path:
        return self.folder / f"{self.function.__name__}-{hashlib.blake2b(key.encode(), digest_size=10).hexdigest()}.nbc"


def _words_of(kind: Any) -> str:
    """Name a Numba type; of a named tuple also the class and the order of its fields, which may be declared in any file."""
    if not hasattr(kind, "types"):
        return repr(kind)
    members = ", ".join(_words_of(member) for member in kind.types)
    owner = getattr(kind, "instance_class", None)
    fields = f" {owner.__module__}.{owner.__qualname__} {kind.fields}" if owner is not None else ""
    return f"{kind!r}{fields} [{members}]"


def _teach_numba() -> None:
    """Let Numba see a kernel, wherever compiled code refers to one, as the dispatcher behind it."""
    from numba.core import types
    from numba.extending import typeof_impl

    if Kernel not in typeof_impl.registry:

        @typeof_impl.register(Kernel)
        def _typeof_kernel(value: Kernel[..., Any], _context: Any) -> Any:
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


def _cache_folder(function: Callable[..., Any]) -> Path | None:
    """Return the folder for the compiled code of a function, or None if its source may change."""
    try:
        sources = _sources_of(function)
    except (OSError, SyntaxError):
        return None  # made interactively, or being edited
    if not all(_as_imported(file) for _, file in sources):
        return None  # edited since it was imported: what runs is not what the files say
    digest = hashlib.blake2b(_platform().encode(), digest_size=10)
    for (module, _), content in sorted(sources.items()):
        digest.update(f"\0{module}\0{len(content)}\0".encode() + content)
    root = _cache_root()
    folder = root / digest.hexdigest()
    try:
        if not folder.exists():
            _remove_old(root)
        folder.mkdir(parents=True, exist_ok=True)
        os.utime(folder)
    except OSError:
        return None
    return folder


def _sources_of(function: Callable[..., Any]) -> dict[tuple[str, str], bytes]:
    """Return the content, by module and file, of all that the compiled code of a function depends on.

    That is this file, the file of every kernel that its code reaches, and the kernel files that those import, which may hold constants.
    """
    found: dict[tuple[str, str], bytes] = {}
    waiting = [(f.__module__, f.__code__.co_filename) for f in _functions_reached(function)]
    while waiting:
        module, file = waiting.pop()
        if (module, file) not in found:
            found[module, file] = content = Path(file).read_bytes()
            waiting += _kernel_files_imported(module, content)
    return found | {(__name__, __file__): Path(__file__).read_bytes()}


def _as_imported(file: str) -> bool:
    stamp = _stamp(file)
    if file in _loaded:
        return stamp is not None and stamp == _loaded[file]
    return stamp is not None and stamp[0] < _begun_ns  # no kernel in it, so nobody took its stamp


def _kernel_files_imported(module: str, content: bytes) -> list[tuple[str, str]]:
    """Return module and file of what a source imports, so far as it is named as a file of kernels or has made kernels."""
    files = {name: getattr(sys.modules.get(name), "__file__", None) for name in _names_imported(module, content)}
    return [(name, file) for name, file in files.items() if file and (file in _loaded or KERNEL_FILE.fullmatch(Path(file).name))]


@cache
def _names_imported(module: str, content: bytes) -> tuple[str, ...]:
    """Return the dotted names that a source imports; of ``from a import b`` both ``a`` and ``a.b``, which may be a module."""

    def names() -> Iterator[str]:
        waiting: list[Any] = [ast.parse(content)]
        while waiting:  # statements only: most of a tree are expressions
            node = waiting.pop()
            waiting += [inner for block in BLOCKS for inner in getattr(node, block, ())]
            if isinstance(node, ast.Import):
                yield from (alias.name for alias in node.names)
            elif isinstance(node, ast.ImportFrom):
                package = getattr(sys.modules.get(module), "__package__", "") or ""
                if node.level > len(package.split(".")) or (node.level and not package):
                    continue
                base = importlib.util.resolve_name("." * node.level + (node.module or ""), package)
                yield base
                yield from (f"{base}.{alias.name}" for alias in node.names)

    return tuple(dict.fromkeys(names()))


def cache_folder() -> Path | None:
    """Return the folder of the compiled kernels, or None where nothing has been compiled yet."""
    root = _cache_root()
    return root if any(root.iterdir()) else None


def _functions_reached(function: Callable[..., Any]) -> list[Callable[..., Any]]:
    """Return a function and every kernel or jitted function that its code refers to, directly or not."""
    found: dict[int, Callable[..., Any]] = {}
    waiting = [function]
    while waiting:
        current = waiting.pop()
        if id(current) not in found:
            found[id(current)] = current
            waiting += [value.py_func for value in _values_named(current) if hasattr(value, "py_func")]
    return list(found.values())


def _values_named(function: Callable[..., Any]) -> list[Any]:
    code, names = function.__code__, function.__globals__
    values = [names[name] for name in code.co_names if name in names]
    values += [cell.cell_contents for cell in function.__closure__ or ()]
    modules = [value for value in values if isinstance(value, ModuleType)]
    return values + [getattr(module, name) for module in modules for name in code.co_names if hasattr(module, name)]


def kernel_files(folder: Path) -> list[Path]:
    """Name the files of kernels in a package."""
    return sorted(path for path in folder.rglob("_*kernels.py") if KERNEL_FILE.fullmatch(path.name))


@lru_cache(maxsize=1)
def _platform() -> str:
    import numba
    from llvmlite import binding  # type: ignore[import-untyped]

    features = binding.get_host_cpu_features().flatten()
    return "|".join([numba.__version__, np.__version__, sys.version, binding.get_host_cpu_name(), features])


def _cache_root() -> Path:
    """Return the first folder that this user can write to: PIXMETRY_CACHE_DIR, the user's cache, a private temporary folder."""
    asked = os.environ.get("PIXMETRY_CACHE_DIR")
    home = os.environ.get("XDG_CACHE_HOME") or os.path.expanduser("~/.cache")
    user = [] if home.startswith("~") else [Path(home) / "pixmetry"]  # a user without a home: a service, a container
    for folder in ([Path(asked)] if asked else []) + user:
        try:
            (folder / "kernels").mkdir(mode=0o700, parents=True, exist_ok=True)
            if _is_ours(folder / "kernels") and os.access(folder / "kernels", os.W_OK | os.X_OK):
                return folder / "kernels"
        except OSError:
            continue
    return _temporary_root()


def _is_ours(folder: Path) -> bool:
    """Whether a folder belongs to this user; its code is executed, so one that others can write to is closed to them, and emptied."""
    status = folder.stat()
    if not hasattr(os, "getuid"):
        return True
    if status.st_uid != os.getuid():
        return False
    if status.st_mode & 0o022:
        folder.chmod(0o700)
        for inside in folder.iterdir():  # what stands in it may be anybody's
            shutil.rmtree(inside) if inside.is_dir() and not inside.is_symlink() else inside.unlink()
    return True


def _temporary_root() -> Path:
    folder = Path(tempfile.gettempdir()) / f"pixmetry-kernels-{getattr(os, 'getuid', int)()}"
    folder.mkdir(mode=0o700, exist_ok=True)
    return folder if _is_ours(folder) else Path(tempfile.mkdtemp(prefix="pixmetry-kernels-"))


def _remove_old(root: Path) -> None:
    """Remove the folders of sources that no process has opened for a month."""
    oldest = time.time() - KEEP_DAYS * 86400
    for folder in root.iterdir():
        try:
            if re.fullmatch("[0-9a-f]{20}", folder.name) and folder.is_dir() and folder.stat().st_mtime < oldest:
                shutil.rmtree(folder, ignore_errors=True)
        except OSError:  # another process was faster
            continue
