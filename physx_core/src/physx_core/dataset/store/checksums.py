"""The checksum of rows and manifest: CRC-32, the same number that every other program computes."""

from __future__ import annotations

from zlib_ng import zlib_ng


def crc32(content: bytes | bytearray | memoryview, before: int = 0) -> int:
    """Return the CRC-32 of bytes.

    zlib-ng computes it several times faster than Python's zlib, with the processor's instructions
    for it, and lets other threads run meanwhile.

    Args:
        content: The bytes, contiguous.
        before: CRC-32 of what stands in front of them.
    """
    return zlib_ng.crc32(content, before)
