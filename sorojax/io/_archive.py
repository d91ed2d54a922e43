"""Zips of plain arrays, read without trusting a byte of them."""

import io
import math
import zipfile
from typing import BinaryIO

import numpy as np

Arrays = dict[str, np.ndarray]
_HEADERS = {
    (1, 0): np.lib.format.read_array_header_1_0,
    (2, 0): np.lib.format.read_array_header_2_0,
}


class Damaged(ValueError):
    """Bytes that `write` did not write; the message says what is wrong with them."""


class TooLarge(ValueError):
    """More bytes than allowed; the message is their number."""


def write(file: BinaryIO, arrays: Arrays) -> None:
    """The arrays by name, not compressed, none of them pickled."""
    with zipfile.ZipFile(file, "w") as archive:
        for name, array in arrays.items():
            with archive.open(f"{name}.npy", "w", force_zip64=True) as entry:
                np.lib.format.write_array(entry, np.asanyarray(array), allow_pickle=False)


def read(content: bytes, max_bytes: int) -> Arrays:
    """The arrays of a file of `write`; sizes are compared before memory is taken.

    Raises:
        Damaged: If it is no such file, or another than was written.
        TooLarge: If it unpacks to more than `max_bytes`.
    """
    try:
        with zipfile.ZipFile(io.BytesIO(content)) as archive:
            entries = archive.infolist()
            size = sum(entry.file_size for entry in entries)
            if size > max_bytes:
                raise TooLarge(str(size))
            if any(entry.compress_type != zipfile.ZIP_STORED for entry in entries):
                raise Damaged("an entry is compressed")
            names = [entry.filename.removesuffix(".npy") for entry in entries]
            if len(set(names)) < len(names):
                raise Damaged("two entries have one name")
            return {
                name: _array(archive.read(entry))
                for name, entry in zip(names, entries, strict=True)
            }
    except (Damaged, TooLarge):
        raise
    except Exception as error:  # zipfile and NumPy raise a dozen kinds at damaged bytes
        raise Damaged(str(error) or type(error).__name__) from error


def _array(data: bytes) -> np.ndarray:
    stream = io.BytesIO(data)
    version = np.lib.format.read_magic(stream)
    if version not in _HEADERS:
        raise Damaged(f"an array of version {version}")
    shape, by_columns, dtype = _HEADERS[version](stream)
    body = memoryview(data)[stream.tell() :]
    if dtype.hasobject:
        raise Damaged("an array of objects")
    if math.prod(shape) * dtype.itemsize != len(body):
        raise Damaged(f"shape {shape} of {dtype} in {len(body)} bytes")
    order = "F" if by_columns else "C"
    return np.ndarray(shape, dtype, bytearray(body), order=order)
