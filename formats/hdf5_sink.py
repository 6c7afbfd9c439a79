"""The file object under an HDF5 file, which hides a full disk from libhdf5.

libhdf5 cannot close a file that it cannot write: it keeps the handle, prints an error for every object and crashes the
interpreter at exit. So writes never fail here; the error is stored, and the writer of the file checks for it.
"""

import os
from pathlib import Path


class Sink:
    """A binary file for `h5py.File` that discards everything after its first failed write.

    Attributes:
        error: the first error of the operating system, or None.
    """

    def __init__(self, path: Path) -> None:
        self.error: OSError | None = None
        self._file = open(path, "w+b", buffering=0)  # noqa: SIM115  closed by `close`
        self._position = 0
        self._end = 0

    def seek(self, offset: int, whence: int = os.SEEK_SET) -> int:
        """Move to `offset` from the start, the current position or the end."""
        self._position = offset + {os.SEEK_SET: 0, os.SEEK_CUR: self._position, os.SEEK_END: self._end}[whence]
        return self._position

    def tell(self) -> int:
        """Return the position in the file."""
        return self._position

    def write(self, content: memoryview) -> int:
        """Write all of `content`, or store the error."""
        remaining = memoryview(content)
        size = remaining.nbytes
        try:
            if self.error is None:
                self._file.seek(self._position)
            while self.error is None and remaining.nbytes:
                remaining = remaining[self._file.write(remaining) :]
        except OSError as cause:
            self.error = cause
        self._position += size
        self._end = max(self._end, self._position)
        return size

    def readinto(self, buffer: memoryview) -> int:
        """Fill all of `buffer`, with zeros past the end of the file."""
        view = memoryview(buffer)
        filled = 0
        if self._file.closed:
            view[:] = bytes(view.nbytes)
            return view.nbytes
        self._file.seek(self._position)
        while filled < view.nbytes and (count := self._file.readinto(view[filled:])):
            filled += count
        view[filled:] = bytes(view.nbytes - filled)
        self._position += view.nbytes
        return view.nbytes

    def read(self, size: int = -1) -> bytes:
        """Read `size` bytes, or the rest of the file."""
        buffer = bytearray(max(self._end - self._position, 0) if size < 0 else size)
        self.readinto(memoryview(buffer))
        return bytes(buffer)

    def truncate(self, size: int | None = None) -> int:
        """Set the length of the file."""
        self._end = self._position if size is None else size
        try:
            if self.error is None:
                self._file.truncate(self._end)
        except OSError as cause:
            self.error = cause
        return self._end

    def flush(self) -> None:
        """Do nothing: writes are not buffered."""

    def close(self) -> None:
        """Close the file; later writes of HDF5 are discarded."""
        if self.error is None:
            self.error = OSError("the file is closed")
        self._file.close()
