"""The checksum of rows and manifest: CRC-32, as every other program computes it."""

from __future__ import annotations

from zlib_ng import zlib_ng


def crc32(content: bytes | bytearray | memoryview, before: int = 0) -> int:
    """Return the CRC-32 of bytes.

    zlib-ng uses the processor's instructions for it, which makes it several times faster than
    Python's zlib, and lets other threads run meanwhile.

    Args:
        content: The bytes, contiguous.
        before: CRC-32 of the bytes that precede them.
    """
    return zlib_ng.crc32(content, before)
