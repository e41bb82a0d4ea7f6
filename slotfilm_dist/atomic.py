"""Files and directories that are either whole or not there, whenever the process or the machine stops.

A reader sees the old content or the new one, never a part. A full disk leaves the old content and no temporary file.
"""

import contextlib
import errno
import hashlib
import os
import shutil
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path

TEMPORARY_SUFFIX = ".partial"
"""Ends the name of everything unfinished; whatever carries it may be deleted while no writer runs."""

RETIRED_SUFFIX = ".retired"
"""Ends the name of a directory while its successor takes its place."""

_READ_BYTES = 1 << 20


@dataclass(frozen=True, kw_only=True, slots=True)
class FileDigest:
    """What a manifest says of a file."""

    num_bytes: int
    """Size in bytes."""
    sha256: str
    """SHA-256 of the content, 64 hex digits."""

    def __post_init__(self) -> None:
        if type(self.num_bytes) is not int or self.num_bytes < 0 or type(self.sha256) is not str:
            raise ValueError(f"num_bytes = {self.num_bytes!r}, sha256 = {self.sha256!r}: is no size and hash of a file")


def write_atomic(path: Path, chunks: Iterable[bytes | memoryview]) -> FileDigest:
    """Write a file in one indivisible step and return its digest.

    The chunks go to a temporary file beside it, which is flushed to the disk and then renamed.

    Raises:
        OSError: the disk is full or the directory not writable; the old file is untouched, the temporary one gone.
    """
    temporary = path.with_name(path.name + TEMPORARY_SUFFIX)
    digest, num_bytes = hashlib.sha256(), 0
    try:
        with temporary.open("wb") as file:
            for chunk in chunks:
                file.write(chunk)
                digest.update(chunk)
                num_bytes += memoryview(chunk).nbytes
            file.flush()
            os.fsync(file.fileno())
        temporary.replace(path)
    except BaseException:
        temporary.unlink(missing_ok=True)
        raise
    fsync_directory(path.parent)
    return FileDigest(num_bytes=num_bytes, sha256=digest.hexdigest())


def append_whole(path: Path, data: bytes) -> None:
    """Append to a file, or leave it as it was.

    Raises:
        OSError: the disk did not take it, or took only a part, which is cut off again.
    """
    with path.open("ab", buffering=0) as file:
        end = file.tell()
        try:
            if file.write(data) != len(data):
                raise OSError(errno.ENOSPC, "was written only in part", str(path))
        except OSError:
            file.truncate(end)
            raise


@contextlib.contextmanager
def replace_directory(path: Path) -> Iterator[Path]:
    """Fill a directory that appears under its name only when the `with` body has ended without an error.

    Yields an empty directory to write into. At the end its files are flushed to the disk and it takes the place of
    `path`, whose old content is kept until then. A crash between the two renames leaves the old content under another
    name, from which `recover_directory` brings it back; a reader calls that first.
    """
    recover_directory(path)
    temporary = path.with_name(path.name + TEMPORARY_SUFFIX)
    retired = path.with_name(path.name + RETIRED_SUFFIX)
    shutil.rmtree(temporary, ignore_errors=True)
    temporary.mkdir(parents=True)
    try:
        yield temporary
        for folder, _, names in os.walk(temporary):
            for name in names:
                _fsync(Path(folder, name))
            fsync_directory(Path(folder))
        if path.exists():
            path.rename(retired)
        temporary.rename(path)
    except BaseException:
        shutil.rmtree(temporary, ignore_errors=True)
        recover_directory(path)
        raise
    fsync_directory(path.parent)
    shutil.rmtree(retired, ignore_errors=True)


def recover_directory(path: Path) -> None:
    """Bring back what `replace_directory` had moved aside when it was interrupted; otherwise do nothing."""
    retired = path.with_name(path.name + RETIRED_SUFFIX)
    if not retired.exists():
        return
    if path.exists():
        shutil.rmtree(retired, ignore_errors=True)
    else:
        retired.rename(path)
        fsync_directory(path.parent)


def file_digest(path: Path) -> FileDigest:
    """Size and SHA-256 of a file, read in pieces."""
    digest, num_bytes = hashlib.sha256(), 0
    with path.open("rb") as file:
        while chunk := file.read(_READ_BYTES):
            digest.update(chunk)
            num_bytes += len(chunk)
    return FileDigest(num_bytes=num_bytes, sha256=digest.hexdigest())


def check_file(path: Path, expected: FileDigest, *, content: bool = True) -> None:
    """Raise ``ValueError`` naming the file if it is missing, cut short or altered.

    Args:
        content: compare the SHA-256 too, not only the size.
    """
    if not path.is_file():
        raise ValueError(f"{path} is missing although the manifest names it")
    size = path.stat().st_size
    if size != expected.num_bytes:
        raise ValueError(f"{path} has {size} bytes where the manifest says {expected.num_bytes}: cut short or altered")
    if content and file_digest(path).sha256 != expected.sha256:
        raise ValueError(f"{path} is corrupt: its SHA-256 differs from the manifest's")


def fsync_directory(path: Path) -> None:
    """Make renames within a directory outlast a power cut."""
    _fsync(path)


def _fsync(path: Path) -> None:
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)
