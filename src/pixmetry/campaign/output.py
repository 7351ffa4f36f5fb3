"""Results on disk: whole or not at all, strict JSON, one array store for maps."""

from __future__ import annotations

import json
import os
import re
import secrets
import shutil
import socket
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from pixmetry.core.errors import InputError

MARKER = ".pixmetry-output.json"
OUTPUT_SCHEMA = "pixmetry/output/1"
_SYSTEM_FILES = {".DS_Store", "Thumbs.db", "desktop.ini"}  # file managers leave these in every folder that is looked at


@contextmanager
def staged_output(directory: str | Path, kind: str) -> Iterator[Path]:
    """Write a folder of results so that it appears whole or not at all.

    Inside the ``with`` block, files go into a temporary folder beside the wanted one; when the block ends well, the folders are
    swapped. After an error or an interruption the old result stands as it was.

    Parameters
    ----------
    directory : str or Path
        The wanted folder. If it exists it must be empty or hold nothing but files of an earlier result of the same kind.
    kind : str
        What is written, in a word (``"assessment"``): a result of another kind is never replaced, for it may be the input.

    Yields
    ------
    Path
        The folder to write into.

    Raises
    ------
    InputError
        If the folder holds other files, or cannot be made.
    """
    target = Path(os.path.realpath(directory))
    check_output(target, kind)
    try:
        target.parent.mkdir(parents=True, exist_ok=True)
        _clean_stale(target)
        check_output(target, kind)
        partial = target.with_name(f"{target.name}.partial-{_host()}-{os.getpid()}-{secrets.token_hex(4)}")
        partial.mkdir()
    except OSError as problem:
        raise InputError("folder cannot be written", where=str(directory), value=problem.strerror, remedy="choose another folder") from None
    try:
        yield partial
        write_json(partial / MARKER, {"schema": OUTPUT_SCHEMA, "kind": kind, "files": sorted(p.name for p in partial.iterdir())})
        check_output(target, kind)  # somebody may have put a file there in the meantime
        _swap(partial, target)
    finally:
        shutil.rmtree(partial, ignore_errors=True)


def _swap(partial: Path, target: Path) -> None:
    old = partial.with_name(partial.name + ".old")
    if target.exists():
        os.replace(target, old)
    try:
        os.replace(partial, target)
    except BaseException:
        if old.exists():
            os.replace(old, target)
        raise
    shutil.rmtree(old, ignore_errors=True)


def check_output(directory: str | Path, kind: str) -> None:
    """Refuse a folder in which something would be lost that no earlier run of the same kind wrote.

    Raises
    ------
    InputError
        If it is a file, or holds other files or a result of another kind.
    """
    target = Path(os.path.realpath(directory))
    if not target.exists():
        return
    if not target.is_dir():
        raise InputError("is a file, not a folder", where=str(target), remedy="choose another folder for the results")
    names = {p.name for p in target.iterdir()}
    own, there = _own_files(target)
    if own and there != kind:
        raise InputError(f"folder holds the result of another command ({there})", where=str(target), remedy="choose another folder")
    foreign = sorted(names - own - _SYSTEM_FILES)
    if foreign:
        shown = ", ".join(foreign[:3]) + (", ..." if len(foreign) > 3 else "")
        remedy = "choose another folder, or move these files away"
        raise InputError(f"folder holds files that are not results of pixmetry ({shown})", where=str(target), remedy=remedy)


def write_page(path: str | Path, text: str) -> Path:
    """Write one HTML page so that it appears whole or not at all; only a page of pixmetry is ever replaced.

    Raises
    ------
    InputError
        If there is something else of that name, or it cannot be written.
    """
    target = Path(path)
    try:
        if target.is_dir():
            raise InputError("is a folder, not a file", where=str(target), remedy="name the page, such as page.html")
        if target.exists() and b'content="pixmetry ' not in target.read_bytes()[:2000]:
            raise InputError("file exists and is no page of pixmetry", where=str(target), remedy="choose another name")
        target.parent.mkdir(parents=True, exist_ok=True)
        partial = target.with_name(f".{target.name}.partial-{os.getpid()}-{secrets.token_hex(4)}")
        try:
            partial.write_text(text, encoding="utf-8")
            os.replace(partial, target)
        finally:
            partial.unlink(missing_ok=True)
    except OSError as problem:
        raise InputError("page cannot be written", where=str(target), value=problem.strerror, remedy="choose another place") from None
    return target


def _own_files(target: Path) -> tuple[set[str], str]:
    """Names of the files that the marker lists, and the kind of result."""
    try:
        marker = json.loads((target / MARKER).read_text(encoding="utf-8"))
        if marker["schema"].startswith("pixmetry/output/"):
            return {MARKER, *marker["files"]}, str(marker["kind"])
    except (OSError, ValueError, KeyError, TypeError, AttributeError):
        pass  # no marker, or not one of ours
    return set(), ""


def _host() -> str:
    return re.sub(r"[^A-Za-z0-9]+", "_", socket.gethostname()) or "host"


def _clean_stale(target: Path) -> None:
    """Remove what killed runs on this machine left; a result that was set aside and never replaced goes back to its place."""
    form = re.compile(re.escape(target.name) + rf"\.partial-{_host()}-(\d+)-[0-9a-f]{{8}}(\.old)?")
    left = [(p, match) for p in target.parent.iterdir() if (match := form.fullmatch(p.name)) and not _alive(int(match[1]))]
    for path, match in left:
        if match[2] and not target.exists():
            os.replace(path, target)
        else:
            shutil.rmtree(path, ignore_errors=True)


def _alive(pid: int) -> bool:
    if os.name == "nt":  # there, signal 0 would end the process instead of asking after it
        return True
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return False
    except PermissionError:
        return True
    return True


def write_json(path: str | Path, obj: Any) -> None:
    """Write strict JSON (RFC 8259): NumPy values become plain ones, and NaN and infinities are refused.

    Parameters
    ----------
    path : str or Path
        Replaced at once when the text is complete.
    obj : mapping, list or plain value

    Raises
    ------
    ValueError
        If a number is not finite; the message names its place. Write None where there is no value.
    TypeError
        If a value has no JSON form.
    """
    text = json.dumps(_plain(obj, "$"), indent=2, ensure_ascii=False, allow_nan=False) + "\n"
    path = Path(path)
    partial = path.with_name(f"{path.name}.partial-{os.getpid()}")
    try:
        partial.write_text(text, encoding="utf-8", newline="\n")
        os.replace(partial, path)
    finally:
        partial.unlink(missing_ok=True)


def _plain(value: Any, at: str) -> Any:
    if isinstance(value, np.ndarray | np.generic):
        value = value.tolist()
    if isinstance(value, Mapping):
        return {str(key): _plain(item, f"{at}.{key}") for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(item, f"{at}[{i}]") for i, item in enumerate(value)]
    if isinstance(value, float) and not np.isfinite(value):
        raise ValueError(f"{at} is {value}: JSON holds finite numbers only")
    if value is None or isinstance(value, str | bool | int | float):
        return value
    raise TypeError(f"{at} is a {type(value).__name__}, which JSON cannot hold")


def write_maps(path: str | Path, maps: Mapping[str, np.ndarray], attrs: Mapping[str, Any]) -> None:
    """Write arrays into one Zarr v3 store: a zip file if the name ends in ``.zip``, else a folder.

    Parameters
    ----------
    path : str or Path
        E.g. ``maps.zarr.zip``. An existing store is replaced.
    maps : mapping of str to ndarray
        Numeric arrays; the name carries the unit (``prnu_map_percent``). NaN is allowed.
    attrs : mapping
        What `write_json` accepts.

    Raises
    ------
    ValueError
        If the attributes are not strict JSON.
    """
    import zarr
    from zarr.codecs import BloscCodec
    from zarr.storage import LocalStore, ZipStore

    path = Path(path)
    store = ZipStore(path, mode="w") if path.suffix == ".zip" else LocalStore(path)
    try:
        group = zarr.create_group(store, zarr_format=3, overwrite=path.suffix != ".zip", attributes=_plain(attrs, "$"))
        for name, array in maps.items():
            array = np.asarray(array)
            codec = BloscCodec(cname="zstd", clevel=5, shuffle="bitshuffle", typesize=array.dtype.itemsize)
            group.create_array(name, data=array, chunks=array.shape if array.nbytes < 1 << 24 else "auto", compressors=[codec])
    finally:
        store.close()


def read_maps(path: str | Path) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
    """Read what `write_maps` wrote.

    Returns
    -------
    tuple
        The arrays by name, and the attributes.

    Raises
    ------
    InputError
        If there is no such store, or if it is damaged.
    """
    from zipfile import is_zipfile

    import zarr
    from zarr.storage import LocalStore, ZipStore

    path = Path(path)
    if not path.exists():
        raise InputError("no such store of maps", where=str(path), remedy="check the name")
    damaged = InputError("not a store of maps, or damaged", where=str(path), remedy="make the result again")
    if path.suffix == ".zip" and not is_zipfile(path):
        raise damaged
    store = ZipStore(path, mode="r") if path.suffix == ".zip" else LocalStore(path, read_only=True)
    try:
        group = zarr.open_group(store, mode="r", zarr_format=3)
        return {name: np.asarray(array[...]) for name, array in sorted(group.arrays())}, dict(group.attrs)
    except FileNotFoundError:
        raise damaged from None
    finally:
        store.close()
