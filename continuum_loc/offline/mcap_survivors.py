"""
What is whole in an MCAP file that its recorder did not close (https://mcap.dev/spec).

Schemas, channels and messages are records of the file, or stand, packed, in chunks. Killed
recorders leave no index, and a last record that ends too soon.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass, field
from io import BytesIO
import os
from pathlib import Path
from struct import unpack_from
import sys
from zlib import crc32

from msg_tools.mcap import records

SCHEMA, CHANNEL, MESSAGE, CHUNK = 3, 4, 5, 6
LARGEST_CHUNK = 2**28  # bytes unpacked: one that states more is damaged, or meant to fill memory


@dataclass(frozen=True)
class Channel:
    """A topic with its type, the type's definition (ROS's .msg text) and the stated metadata."""

    topic: str
    type: str  # noqa: A003  (ROS's word)
    definition: str
    metadata: bytes


@dataclass
class Survivors:
    """
    Iterates over the messages of a file up to where it is cut: (channel, log time ns, data).

    Afterwards `left_over` is the number of bytes at the end that are no whole record, and
    `damaged` the number of chunks that could not be unpacked.
    """

    path: Path
    left_over: int = 0
    damaged: int = 0
    _schemas: dict[int, tuple[str, str]] = field(default_factory=dict)
    _channels: dict[int, Channel] = field(default_factory=dict)

    def __iter__(self) -> Iterator[tuple[Channel, int, bytes]]:
        with self.path.open('rb') as stream:
            end = stream.seek(0, os.SEEK_END)
            for code, content, place, whole in records(stream):
                self.left_over = end - place
                yield from self._messages(code, content, whole)

    def _messages(
        self, code: int, content: bytes, whole: bool, span: tuple[int, int] = (0, 2**64)
    ) -> Iterator:
        try:
            if code == CHUNK:
                yield from self._unpacked(content, whole)
            elif whole and code == SCHEMA:
                name, _, text = _strings(content, 2, 3)
                self._schemas[unpack_from('<H', content)[0]] = name.decode(), text.decode()
            elif whole and code == CHANNEL:
                number, schema = unpack_from('<HH', content)
                topic, _, metadata = _strings(content, 4, 3)
                kind, text = self._schemas[schema]
                self._channels[number] = Channel(topic.decode(), kind, text, metadata)
            elif whole and code == MESSAGE:
                number, _, logged = unpack_from('<HIQ', content)
                if not span[0] <= logged <= span[1]:
                    raise ValueError('a message logged at another time than its chunk says')
                yield self._channels[number], logged, content[22:]
        except Exception:  # what unpackers and decoders say of damaged bytes has no common kind
            self.damaged += 1

    def _unpacked(self, content: bytes, whole: bool) -> Iterator:
        """Messages of a chunk; of the last one, which may be cut, as many as there are."""
        begin, end, size, crc = unpack_from('<QQQI', content)
        (packing,) = _strings(content, 28, 1)
        begins = 28 + 4 + len(packing) + 8
        data = content[begins:]
        if size > LARGEST_CHUNK:
            raise ValueError(f'a chunk of {size} bytes')
        data = _unpack(packing.decode(), data, size)
        if whole and (len(data) != size or (crc and crc32(data) != crc)):
            raise ValueError('a chunk that is not what its checksum says')
        for code, inner, _, complete in records(BytesIO(data), begin=0):
            if complete and code != CHUNK:  # none in another
                yield from self._messages(code, inner, True, (begin, end))


def _strings(content: bytes, place: int, count: int) -> list[bytes]:
    """Strings that follow one another from `place` on, each after its length of 4 bytes."""
    found = []
    for _ in range(count):
        (length,) = unpack_from('<I', content, place)
        place, end = place + 4, place + 4 + length
        found.append(content[place:end])
        if len(found[-1]) < length:
            raise EOFError
        place = end
    return found


def _unpack(packing: str, data: bytes, size: int) -> bytes:
    """At most `size` bytes of a packed chunk, and of one that is cut off what there is."""
    if packing == 'zstd':
        if sys.version_info >= (3, 14):
            from compression import zstd
        else:
            from backports import zstd

        with suppress(EOFError):
            return zstd.ZstdDecompressor().decompress(data, size)
    if packing == 'lz4':
        from lz4.frame import LZ4FrameDecompressor

        return LZ4FrameDecompressor().decompress(data, size)
    if packing:
        raise ValueError(f'packed by {packing}')
    return data[:size]
