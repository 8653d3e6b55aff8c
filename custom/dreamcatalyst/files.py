"""Files that appear whole or not at all, that carry a digest, and whose names every file system takes."""

from __future__ import annotations

import errno
import hashlib
import os
import unicodedata
import zipfile
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, BinaryIO, cast

from .errors import FileError

MARK = b"dreamcatalyst blake2b "  # begins the comment of the zip archive that a saved file is
DIGEST = 16  # bytes of a digest
NAME_BYTES = 120  # of a folder's name at most; file systems take 255, some encrypted ones 143
FULL = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)


# --- writing


@contextmanager
def replacing(path: str | Path, suffix: str = "") -> Iterator[Path]:
    """The path of a part file beside `path`, for the block to write; then it takes the place of `path` at once.

    Until then an earlier file of the name stays as it was, also where the process or the machine dies. Folders are
    made as needed. suffix: of the part file, for writers that go by a name's end.
    Raises FileError for what the file system refuses, or where the block wrote nothing.
    """
    path = Path(path)
    part = path.with_name(f".{path.name}.{os.getpid()}.part{suffix}")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        try:
            yield part
            with part.open("rb") as file:
                os.fsync(file.fileno())
            part.replace(path)
            _sync_folder(path.parent)
        finally:
            part.unlink(missing_ok=True)
    except OSError as error:
        raise unwritable(path, error) from error


def write_bytes(path: str | Path, data: bytes) -> Path:
    """Write a whole file; returns its path. Raises FileError."""
    with replacing(path) as part:
        part.write_bytes(data)
    return Path(path)


def write_text(path: str | Path, text: str) -> Path:
    """Write a whole file as UTF-8; returns its path. Raises FileError."""
    return write_bytes(path, text.encode())


def try_each(writers: Iterable[Callable[[], Any]]) -> None:
    """Call all of `writers`, whatever becomes of the others; then raise the first FileError, if there was one."""
    errors = []
    for write in writers:
        try:
            write()
        except FileError as error:
            errors.append(error)
    if errors:
        raise errors[0]


def unwritable(path: str | Path, error: OSError) -> FileError:
    """What is said of a file that the system does not let us write."""
    remedy = " Free some space, or write elsewhere: exp_root_dir=..." if error.errno in FULL else ""
    reason = error.strerror or _first_line(error) or type(error).__name__
    return FileError(f"{path}: cannot be written: {reason}.{remedy}", full=error.errno in FULL)


def clear_parts(folder: Path) -> None:
    """Remove what killed processes left of files that they had not finished, in `folder` and below."""
    for part in folder.rglob(".*.part*"):
        if part.is_file():
            part.unlink(missing_ok=True)


def _sync_folder(folder: Path) -> None:
    """Have the file system keep a rename through a loss of power."""
    if os.name == "posix":  # elsewhere a folder cannot be opened
        handle = os.open(folder, os.O_RDONLY)
        try:
            os.fsync(handle)
        finally:
            os.close(handle)


# --- tensors with a digest


class _Sink:
    """What torch writes to. It takes an error inside `write` for one of its own, so the error waits for `close`."""

    def __init__(self, file: BinaryIO):
        self.file, self.error = file, None

    def write(self, data: Any) -> int:
        if self.error is None:
            try:
                self.file.write(data)
            except OSError as error:
                self.error = error
        return memoryview(data).nbytes

    def flush(self) -> None:
        """Torch asks for it at the end; `close` does it."""

    def close(self) -> None:
        if self.error is not None:
            raise self.error
        self.file.flush()


def save(path: str | Path, state: Any) -> Path:
    """Write what `torch.save` can, as it does, with a digest of all bytes in the archive's comment, so that any reader
    of torch's files reads it. Raises FileError; an earlier file of the name then stays as it was."""
    import torch

    with replacing(path) as part, part.open("w+b") as file:
        sink = _Sink(file)
        torch.save(state, cast(BinaryIO, sink))
        sink.close()
        end = file.seek(0, os.SEEK_END) - 2  # there stands the length of the comment, 0
        comment = MARK + _digest(file, end).encode()
        file.seek(end)
        file.write(len(comment).to_bytes(2, "little") + comment)
    return Path(path)


def load(path: str | Path) -> tuple[Any, bool]:
    """What `save` (or `torch.save`) wrote, on the CPU, and whether it carries a digest; code in it is never run.

    Raises FileError for a file that is missing, of another kind, or not to the bit what was written (without a digest,
    as far as the archive's own sums tell).
    """
    import torch

    path = Path(path)
    try:
        with path.open("rb") as file:
            sealed = _verify(path, file)
            file.seek(0)
            return torch.load(file, map_location="cpu", weights_only=True), sealed
    except FileError:
        raise
    except Exception as error:  # torch has no error of its own for a file that it cannot read
        raise FileError(f"{path}: cannot be read ({type(error).__name__}: {_first_line(error)})") from error


def _verify(path: Path, file: BinaryIO) -> bool:
    if not zipfile.is_zipfile(file):
        raise FileError(f"{path}: is none of torch's files, or is cut short")
    length = len(MARK) + 2 * DIGEST
    end = file.seek(0, os.SEEK_END) - length - 2
    file.seek(max(end, 0))
    size, comment = int.from_bytes(file.read(2), "little"), file.read(length)
    if end > 0 and comment.startswith(MARK):
        if size != length or comment[len(MARK) :] != _digest(file, end).encode():
            raise FileError(f"{path}: is damaged: its bytes are not those that were written")
        return True
    with zipfile.ZipFile(file) as archive:
        bad = archive.testzip()
        if bad or archive.comment:
            raise FileError(f"{path}: is damaged ({bad or 'at its end'})")
    return False


def _digest(file: BinaryIO, end: int) -> str:
    """Of the first `end` bytes."""
    digest = hashlib.blake2b(digest_size=DIGEST)
    file.seek(0)
    while end > 0:
        block = file.read(min(end, 1 << 20))
        if not block:
            break
        digest.update(block)
        end -= len(block)
    return digest.hexdigest()


def file_digest(path: Path) -> str:
    """A digest of a file's bytes. Raises OSError."""
    with path.open("rb") as file:
        return _digest(file, path.stat().st_size)


def _first_line(error: Exception) -> str:
    return (str(error).splitlines() or [""])[0][:200]


# --- names


def folder_name(text: str, limit: int = NAME_BYTES) -> str:
    """`text` as the name of one folder, at most `limit` bytes: no separators or control characters, no dots or spaces
    at its ends. A text that had to be changed gets a short digest, so that different texts give different names."""
    safe = "".join("_" if c in "/\\" or unicodedata.category(c) in ("Cc", "Cs", "Zl", "Zp") else c for c in text)
    safe = safe.strip(" .")
    if safe == text and len(safe.encode()) <= limit:
        return safe
    mark = "-" + hashlib.blake2b(text.encode("utf-8", "surrogatepass"), digest_size=4).hexdigest()
    return safe.encode()[: limit - len(mark)].decode("utf-8", "ignore").rstrip(" .") + mark
