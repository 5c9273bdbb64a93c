"""Vectors of booleans as bytes, which static fields of a module compare fast."""

import numpy as np


def packed(bits: np.ndarray) -> bytes:
    """Return the booleans behind the number of bits that complete the last byte."""
    return bytes([-bits.size % 8]) + np.packbits(bits).tobytes()


def unpacked(data: bytes) -> np.ndarray:
    surplus, rest = data[0], np.frombuffer(data[1:], np.uint8)
    return np.unpackbits(rest, count=8 * rest.size - surplus).astype(bool)
