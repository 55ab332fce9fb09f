"""Paths of the files of a LeRobot dataset, numbered in numbered folders, and their sizes."""

from __future__ import annotations

from pathlib import Path

FILES_PER_CHUNK = 1000
FILE_MEGABYTES = 100
FILE_BYTES = FILE_MEGABYTES * 1_000_000
_FILE = "chunk-{chunk_index:03d}/file-{file_index:03d}"
DATA_PATH = f"data/{_FILE}.parquet"
VIDEO_PATH = f"videos/{{video_key}}/{_FILE}.mp4"
_EPISODES_PATH = f"meta/episodes/{_FILE}.parquet"


def place_of(number: int) -> tuple[int, int]:
    """Return chunk and file of the n-th file."""
    return divmod(number, FILES_PER_CHUNK)


def data_file(out: Path, chunk: int, file: int) -> Path:
    """Return a file of frames."""
    return out / DATA_PATH.format(chunk_index=chunk, file_index=file)


def video_file(out: Path, name: str, chunk: int, file: int) -> Path:
    """Return a video of a feature."""
    return out / VIDEO_PATH.format(video_key=name, chunk_index=chunk, file_index=file)


def episodes_file(out: Path) -> Path:
    """Return the file of the episodes' records."""
    return out / _EPISODES_PATH.format(chunk_index=0, file_index=0)
