"""What a folder of results holds: strict JSON sealed with digests, and maps in one array store."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np

from pixmetry.core.checksums import check_record, sealed
from pixmetry.core.door import check_archive
from pixmetry.core.errors import InputError
from pixmetry.core.memory import check_memory
from pixmetry.files.output import files_in, replace_file
from pixmetry.files.strict_json import json_text, plain


def write_json(path: str | Path, obj: Any) -> None:
    """Write strict JSON (RFC 8259) as `pixmetry.files.strict_json` makes it: NaN is ``null``, an infinite number ``"inf"``.

    Parameters
    ----------
    path : str or Path
        Replaced at once when the text is complete.
    obj : mapping, list or plain value

    Raises
    ------
    TypeError
        If a value has no JSON form; the message names its place.
    """
    replace_file(Path(path), json_text(obj).encode())


def write_record(path: str | Path, record: Mapping[str, Any]) -> None:
    """Write the main record of a result as strict JSON, last of all: with the digests of itself and of all files in its folder.

    Parameters
    ----------
    path : str or Path
    record : mapping
        As of `write_json`, which tells the errors.
    """
    path = Path(path)
    write_json(path, sealed(plain(record), path.parent, [name for name in files_in(path.parent) if name != path.name]))


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
    TypeError
        If an attribute has no JSON form.
    """
    import zarr
    from zarr.codecs import BloscCodec
    from zarr.storage import LocalStore, ZipStore

    path = Path(path)
    arrays = {name: np.asarray(array) for name, array in maps.items()}
    digests = {name: _digest(array) for name, array in arrays.items()}
    store = ZipStore(path, mode="w") if path.suffix == ".zip" else LocalStore(path)
    try:
        attributes = sealed({"attributes": plain(attrs), "arrays": digests})
        group = zarr.create_group(store, zarr_format=3, overwrite=path.suffix != ".zip", attributes=attributes)
        for name, array in arrays.items():
            codec = BloscCodec(cname="zstd", clevel=5, shuffle="bitshuffle", typesize=array.dtype.itemsize)
            group.create_array(name, data=array, chunks=array.shape if array.nbytes < 1 << 24 else "auto", compressors=[codec])
    finally:
        store.close()


def _digest(array: np.ndarray) -> str:
    """SHA-256 of an array: its shape, the kind of its numbers, and their values, low byte first."""
    kind = array.dtype.newbyteorder("<")
    head = json.dumps([list(array.shape), kind.str]).encode()
    return hashlib.sha256(head + np.ascontiguousarray(array, kind).tobytes()).hexdigest()


def read_maps(path: str | Path) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
    """Read what `write_maps` wrote.

    Returns
    -------
    tuple
        The arrays by name, and the attributes.

    Raises
    ------
    InputError
        If there is no such store, or if it is damaged: an array or a part of one that is missing would be read as zeros.
    """
    import zarr
    from zarr.storage import LocalStore, ZipStore

    path = Path(path)
    if not path.exists():
        raise InputError("no such store of maps", where=str(path), remedy="check the name")
    store: Any = None
    try:
        if path.suffix == ".zip":
            check_archive(path)
        store = ZipStore(path, mode="r") if path.suffix == ".zip" else LocalStore(path, read_only=True)
        group: Any = zarr.open_group(store, mode="r", zarr_format=3)
        record: dict[str, Any] = dict(group.attrs)
        check_record(record, str(path))
        digests, attributes = dict(record["arrays"]), dict(record["attributes"])
        needed = sum(group[name].nbytes for name in digests)
        check_memory(needed, "the maps", where=str(path), remedy="check that it is the right file")
        arrays = {name: np.asarray(group[name][...]) for name in sorted(digests)}
        damaged = [name for name, array in arrays.items() if _digest(array) != digests[name]]
    except Exception as problem:  # the store, its zip file and every codec have their own, and all of them mean that it is damaged
        reason = problem.what if isinstance(problem, InputError) else type(problem).__name__
        raise InputError(f"not a store of maps, or damaged ({reason})", where=str(path), remedy="make the result again") from None
    finally:
        if store is not None:
            with suppress(AttributeError):  # a file that is no zip file was never opened
                store.close()
    if damaged:
        raise InputError(
            f"damaged: the map '{damaged[0]}' has changed since it was written", where=str(path), remedy="make the result again"
        )
    return arrays, attributes
