import hashlib
import resource
from collections.abc import Iterator
from contextlib import contextmanager

import pytest

from slotfilm_dist.atomic import (
    FileDigest,
    check_file,
    file_digest,
    recover_directory,
    replace_directory,
    write_atomic,
)


@contextmanager
def files_at_most(num_bytes: int) -> Iterator[None]:
    """The operating system refuses to let any file grow larger, as a full disk would."""
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (num_bytes, hard))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))


def names(directory) -> list[str]:
    return sorted(path.name for path in directory.iterdir())


def test_file_holds_the_chunks_and_the_digest_tells_them(tmp_path):
    path = tmp_path / "a"
    digest = write_atomic(path, [b"one", memoryview(b"two")])
    assert path.read_bytes() == b"onetwo"
    assert digest == FileDigest(num_bytes=6, sha256=hashlib.sha256(b"onetwo").hexdigest()) == file_digest(path)
    assert names(tmp_path) == ["a"]


def test_failing_source_keeps_the_old_file(tmp_path):
    path = tmp_path / "a"
    write_atomic(path, [b"old"])

    def chunks():
        yield b"new"
        raise RuntimeError("source failed")

    with pytest.raises(RuntimeError, match="source failed"):
        write_atomic(path, chunks())
    assert path.read_bytes() == b"old"
    assert names(tmp_path) == ["a"]


def test_full_disk_keeps_the_old_file(tmp_path):
    path = tmp_path / "a"
    write_atomic(path, [b"old"])
    with pytest.raises(OSError, match="too large"), files_at_most(1000):
        write_atomic(path, [bytes(900), bytes(900)])
    assert path.read_bytes() == b"old"
    assert names(tmp_path) == ["a"]


def test_directory_appears_whole(tmp_path):
    path = tmp_path / "d"
    for content in (b"1", b"2"):
        with replace_directory(path) as filling:
            assert names(filling) == []
            (filling / "sub").mkdir()
            (filling / "sub" / "a").write_bytes(content)
            assert not path.exists() or (path / "sub" / "a").read_bytes() == b"1"
        assert (path / "sub" / "a").read_bytes() == content
        assert names(tmp_path) == ["d"]


def test_failed_directory_keeps_the_old_one(tmp_path):
    path = tmp_path / "d"
    with replace_directory(path) as filling:
        (filling / "a").write_bytes(b"old")
    with pytest.raises(OSError, match="too large"), files_at_most(10), replace_directory(path) as filling:
        (filling / "a").write_bytes(bytes(100))
    assert (path / "a").read_bytes() == b"old"
    assert names(tmp_path) == ["d"]


def test_directory_is_recovered_after_a_crash_between_the_renames(tmp_path):
    path = tmp_path / "d"
    path.mkdir()
    (path / "a").write_bytes(b"old")
    path.rename(tmp_path / "d.retired")
    (tmp_path / "d.partial").mkdir()
    recover_directory(path)
    assert (path / "a").read_bytes() == b"old"
    with replace_directory(path) as filling:
        (filling / "a").write_bytes(b"new")
    assert (path / "a").read_bytes() == b"new"
    assert names(tmp_path) == ["d"]


def test_retired_directory_is_removed_when_its_successor_is_there(tmp_path):
    path = tmp_path / "d"
    path.mkdir()
    (tmp_path / "d.retired").mkdir()
    recover_directory(path)
    assert names(tmp_path) == ["d"]


def test_check_names_the_file_that_is_missing_short_or_altered(tmp_path):
    path = tmp_path / "a"
    digest = write_atomic(path, [b"0123456789"])
    check_file(path, digest)
    path.write_bytes(b"0123456780")
    check_file(path, digest, content=False)
    with pytest.raises(ValueError, match=r"a is corrupt"):
        check_file(path, digest)
    path.write_bytes(b"012345678")
    with pytest.raises(ValueError, match=r"a has 9 bytes where the manifest says 10"):
        check_file(path, digest, content=False)
    path.unlink()
    with pytest.raises(ValueError, match=r"a is missing"):
        check_file(path, digest)
