"""The file under an HDF5 file, made so that HDF5 never learns of a full disk.

libhdf5 cannot close what it cannot write: it keeps the handle, complains at every object's end and crashes the
interpreter when that exits. So writing never fails here; the fault is kept and the writer of the asset looks for it.
"""

import os
from pathlib import Path


class Sink:
    """A binary file for `h5py.File`; after its first failed write it takes everything and keeps nothing.

    Attributes:
        fault: the first error of the operating system, or None.
    """

    def __init__(self, path: Path) -> None:
        self.fault: OSError | None = None
        self._file = open(path, "w+b", buffering=0)  # noqa: SIM115  closed by `close`
        self._place = 0
        self._end = 0

    def seek(self, offset: int, whence: int = os.SEEK_SET) -> int:
        """Move to `offset` from the start, from here or from the end."""
        self._place = offset + {os.SEEK_SET: 0, os.SEEK_CUR: self._place, os.SEEK_END: self._end}[whence]
        return self._place

    def tell(self) -> int:
        """Return the place in the file."""
        return self._place

    def write(self, content: memoryview) -> int:
        """Write all of `content`, or remember why not."""
        remaining = memoryview(content)
        size = remaining.nbytes
        try:
            if self.fault is None:
                self._file.seek(self._place)
            while self.fault is None and remaining.nbytes:
                remaining = remaining[self._file.write(remaining) :]
        except OSError as cause:
            self.fault = cause
        self._place += size
        self._end = max(self._end, self._place)
        return size

    def readinto(self, buffer: memoryview) -> int:
        """Fill all of `buffer`, with zeros where nothing was kept."""
        view = memoryview(buffer)
        filled = 0
        if self._file.closed:
            view[:] = bytes(view.nbytes)
            return view.nbytes
        self._file.seek(self._place)
        while filled < view.nbytes and (count := self._file.readinto(view[filled:])):
            filled += count
        view[filled:] = bytes(view.nbytes - filled)
        self._place += view.nbytes
        return view.nbytes

    def read(self, size: int = -1) -> bytes:
        """Read `size` bytes, or all that are left."""
        buffer = bytearray(max(self._end - self._place, 0) if size < 0 else size)
        self.readinto(memoryview(buffer))
        return bytes(buffer)

    def truncate(self, size: int | None = None) -> int:
        """Set the length of the file."""
        self._end = self._place if size is None else size
        try:
            if self.fault is None:
                self._file.truncate(self._end)
        except OSError as cause:
            self.fault = cause
        return self._end

    def flush(self) -> None:
        """Nothing is held back: writes are not buffered."""

    def close(self) -> None:
        """Close the file; what HDF5 may still write afterwards is dropped."""
        if self.fault is None:
            self.fault = OSError("the file is closed")
        self._file.close()
