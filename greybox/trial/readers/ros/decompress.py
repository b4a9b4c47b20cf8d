"""Inflating what bags hold compressed: checked before and after, never as a whole unasked."""

from __future__ import annotations

import bz2
from pathlib import Path
from typing import IO

import lz4.frame
import zstandard

from greybox.errors import LogError
from greybox.trial.readers.limits import limits
from greybox.trial.readers.ros.storage import Budget


def inflate_zstd(data: bytes, limit: int) -> bytes:
    """Return at most `limit` bytes; what comes before the damage where there is some."""
    inflater = zstandard.ZstdDecompressor(max_window_size=limits().window_bytes)
    parts: list[bytes] = []
    try:
        with inflater.stream_reader(data, read_across_frames=True) as stream:
            # in blocks, for what is asked for is allocated whether it comes or not
            while limit and (part := stream.read(min(limit, limits().block_bytes))):
                parts.append(part)
                limit -= len(part)
    except zstandard.ZstdError:
        pass
    return b"".join(parts)


def inflate_file(source: IO[bytes], target: Path, budget: Budget) -> None:
    """Inflate a file that zstd compressed as a whole.

    Raises
    ------
    LogError
        It is damaged, or exceeds the budget.
    """
    inflater = zstandard.ZstdDecompressor(max_window_size=limits().window_bytes)
    try:
        with inflater.stream_reader(source, closefd=False) as stream, open(target, "wb") as sink:
            while block := stream.read(limits().block_bytes):
                budget.charge(len(block))
                sink.write(block)
    except zstandard.ZstdError as error:
        raise LogError(
            f"'{budget.name}' is zstd-compressed and damaged ({error}): "
            f"copy the file again, or name another."
        ) from None


def inflate(data: bytes, kind: str, stated: int, budget: Budget) -> bytes:
    """Return a chunk's content: what the file states is checked before and after.

    Parameters
    ----------
    data : bytes
    kind : str
        ``lz4``, ``bz2``, ``zstd``, ``none`` or empty.
    stated : int
        Bytes that the file says it inflates to.
    budget : Budget

    Raises
    ------
    LogError
        The compression is not known, or there is more than stated or allowed.
    """
    if kind in ("none", ""):
        return data
    if kind not in ("lz4", "bz2", "zstd"):
        raise LogError(
            f"'{budget.name}' is compressed with '{kind}', which is not read "
            f"(lz4, bz2, zstd and none are): write it again without compression."
        )
    budget.charge(stated)
    limit = stated + 1
    try:
        if kind == "lz4":
            raw = bytes(lz4.frame.LZ4FrameDecompressor().decompress(data, max_length=limit))
        elif kind == "bz2":
            raw = bz2.BZ2Decompressor().decompress(data, max_length=limit)
        else:
            raw = inflate_zstd(data, limit)
    # lz4 and bz2 say damaged data in their own ways
    except (RuntimeError, OSError, ValueError, EOFError):
        return b""
    if len(raw) > stated:
        raise LogError(
            f"'{budget.name}' holds a chunk that inflates to more than the {stated} bytes that "
            f"it states: the file is damaged or hostile, record or copy it again."
        )
    return raw
