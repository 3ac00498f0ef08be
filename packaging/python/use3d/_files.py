"""The open formats that artifacts are made of, as NumPy arrays."""

import json
import os

import numpy as np


class FormatError(ValueError):
    """A file that is not what its name says: which, and what is wrong."""


# Little-endian, as the format has them. bfloat16 has no NumPy type and comes as its 16 bits.
_SAFETENSORS = {
    "F64": "<f8", "F32": "<f4", "F16": "<f2", "BF16": "<u2", "I64": "<i8", "I32": "<i4", "I16": "<i2", "I8": "i1",
    "U64": "<u8", "U32": "<u4", "U16": "<u2", "U8": "u1", "BOOL": "?",
}  # fmt: skip
_PLY = {
    "char": "i1", "int8": "i1", "uchar": "u1", "uint8": "u1", "short": "<i2", "int16": "<i2", "ushort": "<u2",
    "uint16": "<u2", "int": "<i4", "int32": "<i4", "uint": "<u4", "uint32": "<u4", "float": "<f4", "float32": "<f4",
    "double": "<f8", "float64": "<f8",
}  # fmt: skip


def read_safetensors(path):
    """A safetensors file as a dict from name to array."""
    size = os.path.getsize(path)
    with open(path, "rb") as file:
        length = int.from_bytes(file.read(8), "little")
        if size < 8 or length > size - 8:
            raise FormatError(f"{path}: not a safetensors file, or cut off: its header has {length} bytes")
        try:
            header = json.loads(file.read(length))
            entries = {name: entry for name, entry in header.items() if name != "__metadata__"}
        except (ValueError, AttributeError) as error:
            raise FormatError(f"{path}: its header is not JSON: {error}") from error
        data = file.read()
    tensors = {}
    for name, entry in entries.items():
        try:
            kind = np.dtype(_SAFETENSORS[entry["dtype"]])
            shape = tuple(int(n) for n in entry["shape"])
            start, end = (int(n) for n in entry["data_offsets"])
        except (KeyError, TypeError, ValueError) as error:
            raise FormatError(f"{path}: tensor {name!r} is not described as it should be: {error!r}") from error
        count = int(np.prod(shape, dtype=np.int64))
        if not 0 <= start <= end <= len(data) or min(shape, default=0) < 0 or end - start != count * kind.itemsize:
            raise FormatError(f"{path}: tensor {name!r} has {end - start} bytes at {start}, of shape {shape} and {kind}")
        tensors[name] = np.frombuffer(data[start:end], kind).reshape(shape)
    return tensors


def read_ply(path):
    """The vertices of a binary little-endian PLY (a scene's Gaussians) as a structured array, one field a property."""
    with open(path, "rb") as file:
        if file.readline().strip() != b"ply":
            raise FormatError(f"{path}: not a PLY file")
        count, fields, here = None, [], False
        while True:
            line = file.readline()
            words = line.decode("ascii", "replace").split()
            if not line:
                raise FormatError(f"{path}: its header has no end")
            if words[:1] == ["end_header"]:
                break
            if words[:1] == ["format"] and words[1:2] != ["binary_little_endian"]:
                raise FormatError(f"{path}: format {' '.join(words[1:])}; binary_little_endian is expected")
            if words[:1] == ["element"]:
                here = words[1:2] == ["vertex"]
                if not here and count is None:
                    raise FormatError(f"{path}: the first element is {' '.join(words[1:])}; vertices are expected")
                if here:
                    count = int(words[2])
            if words[:1] == ["property"] and here:
                if len(words) != 3 or words[1] not in _PLY:
                    raise FormatError(f"{path}: property {' '.join(words[1:])}, which no Gaussian has")
                fields.append((words[2], _PLY[words[1]]))
        if not fields or count is None:
            raise FormatError(f"{path}: it has no vertices")
        kind = np.dtype(fields)
        data = file.read(count * kind.itemsize)
    if len(data) != count * kind.itemsize:
        raise FormatError(f"{path}: cut off: {len(data)} bytes of {count} vertices of {kind.itemsize} bytes")
    return np.frombuffer(data, kind)
