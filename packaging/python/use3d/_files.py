"""Reads the open formats of artifacts as NumPy arrays."""

from __future__ import annotations

import json
import math
import os

try:
    import numpy as np
except ImportError:

    class _Missing:
        """Stands where NumPy would be. Runs, tables and paths need no arrays."""

        def __getattr__(self, name):
            raise ImportError("arrays and pictures need NumPy: pip install numpy")

    np = _Missing()


class FormatError(ValueError):
    """A file is not in the format of its name. The message names the file and the fault."""


# Little-endian, as in the format. bfloat16 has no NumPy type and is returned as its 16 bits.
_SAFETENSORS = {
    "F64": "<f8", "F32": "<f4", "F16": "<f2", "BF16": "<u2", "I64": "<i8", "I32": "<i4", "I16": "<i2", "I8": "i1",
    "U64": "<u8", "U32": "<u4", "U16": "<u2", "U8": "u1", "BOOL": "?",
}  # fmt: skip
_PLY = {
    "char": "i1", "int8": "i1", "uchar": "u1", "uint8": "u1", "short": "<i2", "int16": "<i2", "ushort": "<u2",
    "uint16": "<u2", "int": "<i4", "int32": "<i4", "uint": "<u4", "uint32": "<u4", "float": "<f4", "float32": "<f4",
    "double": "<f8", "float64": "<f8",
}  # fmt: skip
# Limits for a header; that of a scene's PLY has about sixty lines.
_PLY_LINE, _PLY_HEADER = 1 << 12, 1 << 20


def read_safetensors(path: str | os.PathLike[str]) -> dict[str, np.ndarray]:
    """Reads a safetensors file as a dict from name to array. The arrays are read-only; `array.copy()` can be
    written.
    """
    size = os.path.getsize(path)
    with open(path, "rb") as file:
        length = int.from_bytes(file.read(8), "little")
        if size < 8 or length > size - 8:
            raise FormatError(f"{path}: not a safetensors file, or cut off: its header has {length} bytes")
        try:
            header = json.loads(file.read(length))
            entries = {name: entry for name, entry in header.items() if name != "__metadata__"}
        except (ValueError, AttributeError, RecursionError) as error:
            raise FormatError(f"{path}: its header is not JSON of the names and places of tensors: {error}") from error
        data = file.read()
    tensors = {}
    for name, entry in entries.items():
        try:
            kind = np.dtype(_SAFETENSORS[entry["dtype"]])
            shape = tuple(_whole(n) for n in entry["shape"])
            if len(shape) > 64:
                raise ValueError(f"{len(shape)} dimensions; at most 64 are expected")
            start, end = (_whole(n) for n in entry["data_offsets"])
        except (KeyError, TypeError, ValueError) as error:
            raise FormatError(f"{path}: tensor {name!r} is not described as it should be: {error!r}") from error
        # Python integers have no upper limit; a 64-bit product could overflow to a small number.
        if not start <= end <= len(data) or end - start != math.prod(shape) * kind.itemsize:
            raise FormatError(f"{path}: tensor {name!r} has {end - start} bytes at {start}, of shape {shape} and {kind}")
        try:
            tensors[name] = np.frombuffer(memoryview(data)[start:end], kind).reshape(shape)
        except (ValueError, OverflowError, MemoryError) as error:
            raise FormatError(f"{path}: tensor {name!r} has shape {shape}, which no array has: {error}") from error
    return tensors


def _whole(number):
    if type(number) is not int or number < 0:
        raise ValueError(f"{number!r} where a whole number is expected")
    return number


def read_ply(path: str | os.PathLike[str]) -> np.ndarray:
    """Reads the vertices of a binary little-endian PLY (a scene's Gaussians) as a structured array, one field
    per property.

    The array is read-only; `array.copy()` can be written.
    """
    size = os.path.getsize(path)
    with open(path, "rb") as file:
        if file.readline(_PLY_LINE).strip() != b"ply":
            raise FormatError(f"{path}: not a PLY file")
        count, fields, here, form = None, {}, False, None
        while True:
            line = file.readline(_PLY_LINE)
            words = line.decode("ascii", "replace").split()
            if not line.endswith(b"\n") or file.tell() > _PLY_HEADER:
                raise FormatError(f"{path}: its header has no end")
            if words[:1] == ["end_header"]:
                break
            if words[:1] == ["format"]:
                form = words[1:]
                if form[:1] != ["binary_little_endian"]:
                    raise FormatError(f"{path}: format {' '.join(form)}; binary_little_endian is expected")
            if words[:1] == ["element"]:
                here = words[1:2] == ["vertex"]
                if not here and count is None:
                    raise FormatError(f"{path}: the first element is {' '.join(words[1:])}; vertices are expected")
                if here and count is not None:
                    raise FormatError(f"{path}: it has vertices twice")
                if here:
                    count = _count(path, words[2:])
            if words[:1] == ["property"] and here:
                if len(words) != 3 or words[1] not in _PLY:
                    raise FormatError(f"{path}: property {' '.join(words[1:])}, which no Gaussian has")
                if words[2] in fields:
                    raise FormatError(f"{path}: property {words[2]} is there twice")
                fields[words[2]] = _PLY[words[1]]
        if form is None:
            raise FormatError(f"{path}: its header names no format; binary_little_endian is expected")
        if not fields or count is None:
            raise FormatError(f"{path}: it has no vertices")
        kind = np.dtype(list(fields.items()))
        left = size - file.tell()
        # Checked before memory is allocated, because a header can name any number.
        if left < count * kind.itemsize:
            raise FormatError(f"{path}: cut off: {left} bytes of {count} vertices of {kind.itemsize} bytes")
        data = file.read(count * kind.itemsize)
    if len(data) != count * kind.itemsize:
        raise FormatError(f"{path}: cut off: {len(data)} bytes of {count} vertices of {kind.itemsize} bytes")
    return np.frombuffer(data, kind)


def _count(path, words):
    # Text with more digits than 64 bits can hold is not a count, and slow to parse.
    if len(words) != 1 or not words[0].isdecimal() or not words[0].isascii() or len(words[0]) > 19:
        raise FormatError(f"{path}: element vertex {' '.join(words)}; a number of vertices is expected")
    return int(words[0])
