"""Reads and writes pictures with NumPy alone: those of `use3d render`, and small ones for notebooks."""

from __future__ import annotations

import base64
import os
import struct
import zlib
from pathlib import Path

from ._files import FormatError, np

# The largest number of pixels that a header may name.
_PIXELS = 1 << 28
_PNG = b"\x89PNG\r\n\x1a\n"


def read_exr(path: str | os.PathLike[str]) -> dict[str, np.ndarray]:
    """Reads a picture of `use3d render --format exr` as a dict from channel (`R`, `G`, `B`; `Z` for depth, `A`
    for alpha) to an array of height × width.
    """
    return _read(path, _exr, "no EXR picture of 32-bit numbers as `use3d render` writes it")


def read_png(path: str | os.PathLike[str]) -> np.ndarray:
    """Reads an 8-bit PNG as an array of height × width × channels."""
    return _read(path, _png, "no PNG picture with 8 bits per channel")


def _read(path, decode, expected):
    data = Path(path).read_bytes()
    try:
        return decode(data)
    except (IndexError, KeyError, ValueError, struct.error, zlib.error) as error:
        raise FormatError(f"{path}: {expected}: {error!r}") from error


def _sides(width, height):
    if not (0 < width and 0 < height and width * height <= _PIXELS):
        raise ValueError(f"{width}x{height} pixels")
    return width, height


def _exr(data):
    if data[:8] != b"\x76\x2f\x31\x01\x02\x00\x00\x00":
        raise ValueError("another magic number")
    at, fields = 8, {}
    while data[at]:
        name, kind = data.index(b"\0", at), data.index(b"\0", data.index(b"\0", at) + 1)
        (size,) = struct.unpack_from("<I", data, kind + 1)
        fields[data[at:name]] = data[kind + 5 : kind + 5 + size]
        at = kind + 5 + size
    left, top, right, bottom = struct.unpack("<4i", fields[b"dataWindow"])
    width, height = _sides(right - left + 1, bottom - top + 1)
    channels, names = fields[b"channels"], []
    while channels[0]:
        name, channels = channels.split(b"\0", 1)
        if channels[0] != 2:
            raise ValueError(f"channel {name!r} has another type")
        names.append(name.decode())
        channels = channels[16:]
    # The ways of compressing: none, ZIP by lines, ZIP by 16 lines.
    lines = {0: 1, 2: 1, 3: 16}[fields[b"compression"][0]]
    # Every line of a file has some bytes, so a short file ends here, before memory is allocated.
    blocks = -(-height // lines)
    if len(data) < at + 16 * blocks:
        raise ValueError("cut off")
    pixels = np.empty((height, len(names), width), "<f4")
    at += 1 + 8 * blocks
    for y in range(0, height, lines):
        (size,) = struct.unpack_from("<I", data, at + 4)
        block, rows = data[at + 8 : at + 8 + size], pixels[y : y + lines]
        at += 8 + size
        if size < rows.nbytes:
            # Bytes are stored as differences plus 128; the even ones come before the odd ones.
            steps = np.frombuffer(zlib.decompress(block), "u1") - np.uint8(128)
            steps[0] ^= 128
            bytes_ = np.cumsum(steps, dtype="u1")
            half = (len(bytes_) + 1) // 2
            block = np.empty_like(bytes_)
            block[0::2], block[1::2] = bytes_[:half], bytes_[half:]
        rows[...] = np.frombuffer(block, "<f4").reshape(rows.shape)
    return {name: pixels[:, i] for i, name in enumerate(names)}


def _png(data):
    if data[:8] != _PNG:
        raise ValueError("another signature")
    at, packed = 8, []
    while data[at + 4 : at + 8] != b"IEND":
        (size,) = struct.unpack_from(">I", data, at)
        kind, chunk = data[at + 4 : at + 8], data[at + 8 : at + 8 + size]
        if kind == b"IHDR":
            width, height, depth, colour, _, _, interlaced = struct.unpack(">IIBBBBB", chunk)
        if kind == b"IDAT":
            packed.append(chunk)
        at += 12 + size
    channels = {0: 1, 2: 3, 4: 2, 6: 4}[colour]
    if depth != 8 or interlaced:
        raise ValueError(f"{depth} bits, interlaced {interlaced}")
    width, height = _sides(width, height)
    length = height * (1 + width * channels)
    rows = np.frombuffer(zlib.decompressobj().decompress(b"".join(packed), length), "u1").reshape(height, -1)
    return _unfiltered(rows[:, 0], rows[:, 1:].reshape(height, width, channels))


def _unfiltered(kinds, steps):
    """The pixels behind the differences of a PNG. A pixel needs those to the left of it and above it, so all
    pixels of a diagonal are computed together.
    """
    height, width, channels = steps.shape
    padded = np.zeros(((height + 1) * (width + 1), channels), "i2")
    flat = steps.reshape(-1, channels)
    for d in range(height + width - 1):
        first, last = max(0, d - width + 1), min(height - 1, d)
        count = last - first + 1

        def diagonal(row, column):
            start = row * (width + 1) + column
            return padded[start : start + (count - 1) * width + 1 : width]

        column = d - first
        corner, above, left = diagonal(first, column), diagonal(first, column + 1), diagonal(first + 1, column)
        kind = kinds[first : last + 1, None]
        start = first * width + column
        step = flat[start : start + (count - 1) * (width - 1) + 1 : max(width - 1, 1)][:count]
        guess = np.where(kind == 1, left, np.where(kind == 2, above, 0))
        guess = np.where(kind == 3, (left + above) >> 1, np.where(kind == 4, _paeth(left, above, corner), guess))
        diagonal(first + 1, column + 1)[...] = (step + guess) & 255
    return padded.reshape(height + 1, width + 1, channels)[1:, 1:].astype("u1")


def _paeth(left, above, corner):
    """Paeth's predictor of PNG."""
    by_left, by_above, by_both = abs(above - corner), abs(left - corner), abs(left + above - 2 * corner)
    return np.where(
        (by_left <= by_above) & (by_left <= by_both), left, np.where(by_above <= by_both, above, corner)
    )


def _as_png(pixels):
    """An array of height × width × 3 with 8 bits as a PNG file."""
    height, width, channels = pixels.shape
    padded = np.zeros((height + 1, width + 1, channels), "i2")
    padded[1:, 1:] = pixels
    guess = _paeth(padded[1:, :-1], padded[:-1, 1:], padded[:-1, :-1])
    rows = np.full((height, 1 + width * channels), 4, "u1")
    rows[:, 1:] = ((padded[1:, 1:] - guess) & 255).reshape(height, -1)

    def chunk(kind, data):
        return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))

    head = chunk(b"IHDR", struct.pack(">IIBBBBB", width, height, 8, 2, 0, 0, 0))
    return _PNG + head + chunk(b"IDAT", zlib.compress(rows.tobytes(), 9)) + chunk(b"IEND", b"")


def small(pixels: np.ndarray, side: int) -> str:
    """An HTML picture with no side longer than `side` (each of its pixels is the mean of a square). `pixels`
    has 8 bits, or floating-point numbers of which 1 is white.
    """
    if pixels.dtype != np.uint8:
        pixels = (255 * np.clip(np.nan_to_num(pixels), 0, 1) + 0.5).astype("u1")
    pixels = pixels[:, :, :3] if pixels.shape[2] >= 3 else np.repeat(pixels[:, :, :1], 3, 2)
    by = -(-max(pixels.shape[:2]) // side)
    height, width = (max(1, n // by) for n in pixels.shape[:2])
    pixels = pixels[: height * by, : width * by].reshape(height, min(by, pixels.shape[0]), width, -1, 3)
    pixels = np.round(pixels.mean((1, 3))).astype("u1")
    text = base64.b64encode(_as_png(pixels)).decode()
    return f'<img src="data:image/png;base64,{text}" width="{width}" height="{height}" alt="">'
