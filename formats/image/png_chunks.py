"""The chunks of a PNG that decide its values and colours (third edition, https://www.w3.org/TR/png-3/).

Pillow puts texts and chunks into one table, so that a text with the keyword gamma counts as gAMA, and it refuses long
texts. It is therefore given the file without them.
"""

import os
import re
import struct
import zlib
from collections.abc import Iterator
from dataclasses import dataclass

from formats.errors import ImageError
from formats.image.refusals import refuse_size, refuse_truncated

_CHANNELS = {0: 1, 2: 3, 3: 1, 4: 2, 6: 4}
"""Stored channels by the colour type."""
_MOST_DEFLATED = 1032
"""Bytes that a byte of a zlib stream expands to, at most."""
_COLOURS = (b"tRNS", b"cICP", b"iCCP", b"sRGB", b"gAMA", b"cHRM")
_FOR_PILLOW = (b"tRNS", b"eXIf", b"acTL", b"fcTL", b"fdAT")
_WITH_ORIENTATION = (b"XML:com.adobe.xmp\0", b"Raw profile type exif\0")
_MOST_TEXT, _MOST_DEFLATED_TEXT, _MOST_PROFILE = 2**24, 2**14, 2**24
"""Bytes. Pillow refuses a file with a text of more than 1 MiB that is compressed."""
_EXPOSURE = re.compile(rb"exposure\0([-+.\de]{1,20} EV)", re.ASCII)
_COMMAND = b"prtbake.command" + 5 * b"\0"
"""What prtbake writes into its pictures: the exposure, and the command, in iTXt without compression and language."""


@dataclass
class PngChunks:
    """What the chunks of a PNG say, beside its pixels.

    Attributes:
        content: the file without texts and other chunks that do not matter.
        bits: of a channel.
        cicp: the cICP chunk.
        clear: the grey or RGB that is transparent (tRNS), in `bits`.
        profile: the colour profile (iCCP); empty if it is damaged.
        srgb: whether there is an sRGB chunk.
        gamma: the gAMA chunk.
        chromaticity: the cHRM chunk: white, red, green and blue in x and y.
        exposure: with which prtbake wrote the picture.
        command: that wrote the picture, of prtbake.
    """

    content: bytes = b""
    bits: int = 8
    cicp: bytes | None = None
    clear: tuple[int, ...] | None = None
    profile: bytes | None = None
    srgb: bool = False
    gamma: float | None = None
    chromaticity: tuple[float, ...] | None = None
    exposure: str = "0 EV"
    command: str = ""


def read_chunks(path: str | os.PathLike[str]) -> PngChunks:
    """Read the chunks of a PNG.

    Raises:
        ImageError: the file is damaged, or too short for its size.
    """
    found, colour, kept = PngChunks(), 0, [b"\x89PNG\r\n\x1a\n"]
    for kind, content in _chunks(path):
        if kind == b"IHDR" and len(content) == 13:
            width, height, found.bits, colour = struct.unpack(">IIBB", content[:10])
            refuse_size(path, width, height)
            row_bytes = width * found.bits * _CHANNELS.get(colour, 1) // 8
            refuse_truncated(path, width, height, height * row_bytes // _MOST_DEFLATED)
        if _is_for_pillow(kind, content):
            length, checksum = struct.pack(">I", len(content)), zlib.crc32(content, zlib.crc32(kind))
            kept += [length, kind, content, struct.pack(">I", checksum)]
        _add(found, kind, content, colour)
    found.content = b"".join(kept)
    return found


def _add(found: PngChunks, kind: bytes, content: bytes, colour: int) -> None:
    match kind, len(content):
        case b"cICP", 4:
            found.cicp = content
        case b"tRNS", (2 | 6) as size if (colour, size) in ((0, 2), (2, 6)):
            found.clear = struct.unpack(f">{size // 2}H", content)
        case b"sRGB", 1:
            found.srgb = True
        case b"gAMA", 4:
            found.gamma = struct.unpack(">I", content)[0] / 1e5
        case b"cHRM", 32:
            found.chromaticity = tuple(value / 1e5 for value in struct.unpack(">8I", content))
        case b"iCCP", _:
            found.profile = _inflated(content.partition(b"\0")[2][1:])
        case b"tEXt", _ if text := _EXPOSURE.fullmatch(content):
            found.exposure = text[1].decode()
        case b"iTXt", _ if content.startswith(_COMMAND):
            found.command = content.removeprefix(_COMMAND).decode("utf-8", "replace")


def _inflated(content: bytes) -> bytes:
    try:
        return zlib.decompressobj().decompress(content, _MOST_PROFILE)
    except zlib.error:
        return b""


def _is_for_pillow(kind: bytes, content: bytes) -> bool:
    """Whether a chunk holds pixels, or the orientation."""
    if kind in (b"tEXt", b"zTXt", b"iTXt"):
        plain = kind == b"tEXt" or (kind == b"iTXt" and content.partition(b"\0")[2][:1] == b"\0")
        return content.startswith(_WITH_ORIENTATION) and len(content) <= (_MOST_TEXT if plain else _MOST_DEFLATED_TEXT)
    return kind[:1].isupper() or kind in _FOR_PILLOW


def _chunks(path: str | os.PathLike[str]) -> Iterator[tuple[bytes, bytes]]:
    """Yield the kinds and contents of the chunks; those whose kind begins with a capital are critical.

    Others are left out if they are damaged, unless colours depend on them. Raises ImageError if the checksum of a
    chunk that matters is wrong, which Pillow does not compare, or if the end is missing.
    """
    with open(path, "rb") as file:
        file.seek(8)  # the signature
        while len(head := file.read(8)) == 8:
            length, kind = struct.unpack(">I4s", head)
            content, checksum = file.read(length), file.read(4)
            if checksum == struct.pack(">I", zlib.crc32(content, zlib.crc32(kind))):
                yield kind, content
            elif kind[:1].isupper() or kind in _COLOURS:
                place = f"the chunk {kind.decode('latin-1')!a} at byte {file.tell() - len(content) - 12}"
                raise ImageError(f"{path}: is truncated or damaged in {place}: its checksum is wrong; copy it again")
            if kind == b"IEND":
                return
    raise ImageError(f"{path}: is truncated: its last chunk, IEND, is missing; copy it again")
