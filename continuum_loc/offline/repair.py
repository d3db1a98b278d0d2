"""Bags whose recorder was killed, or whose disk was full: what is whole in them, as a new bag."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from continuum_loc.errors import BagError
from continuum_loc.offline.mcap_survivors import Channel, Survivors
from msg_tools.bag import open_bag, storage_files
from msg_tools.factory import typestore


@dataclass
class Repaired:
    """
    What was saved, by topic, and over how long; what was not, in words.

    first, last: log times of the messages saved [ns].
    """

    saved: Counter[str] = field(default_factory=Counter)
    first: int = 0
    last: int = 0
    lost: list[str] = field(default_factory=list)

    @property
    def seconds(self) -> float:
        """Time from the first to the last message saved [s]."""
        return 1e-9 * (self.last - self.first)


def repair(bag: Path, out: Path) -> Repaired:
    """
    Write all messages that are whole in `bag`, a folder or file, into the new bag folder `out`.

    `bag` stays as it is. Raises BagError where nothing can be saved, or `out` is there already.
    """
    if not bag.exists():
        raise BagError(f'{bag}: no such bag')
    files = storage_files(bag)
    if out.exists():
        raise BagError(f'{out}: exists already; give a new folder')
    if not files:
        raise BagError(f'{bag}: holds no .mcap or .db3 file')
    done = Repaired()
    found = ((channel, at, data) for file in files for channel, at, data in _whole(file, done))
    first = next(found, None)
    if first is None:
        why = '; '.join(done.lost) or 'it is empty, or of another kind'
        raise BagError(f'{bag}: holds no whole message; {why}')
    _write(out, first, found, done)
    return done


def _write(out: Path, first: Any, found: Iterator, done: Repaired) -> None:
    from rosbags.rosbag2 import StoragePlugin, Writer

    connections: dict[Channel, Any] = {}
    channel, at, data = first
    done.first = at
    try:
        with Writer(out, version=9, storage_plugin=StoragePlugin.MCAP) as writer:
            while True:
                if channel not in connections:
                    connections[channel] = _connect(writer, channel)
                writer.write(connections[channel], at, data)
                done.saved[channel.topic] += 1
                done.first, done.last = min(done.first, at), max(done.last, at)
                channel, at, data = next(found, (None, 0, b''))
                if channel is None:
                    return
    except OSError as error:
        raise BagError(f'{out}: cannot be written ({error.strerror})') from None


def _whole(file: Path, done: Repaired) -> Iterator[tuple[Channel, int, bytes]]:
    if file.suffix != '.mcap':  # SQLite keeps its own file whole
        with open_bag(file) as reader:
            for c, at, data in reader.messages():
                yield Channel(c.topic, c.msgtype, c.msgdef.data, b''), at, data
        return
    survivors = Survivors(file)
    yield from survivors
    if survivors.damaged:
        done.lost.append(f'{file.name}: {survivors.damaged} damaged records')
    if survivors.left_over:
        done.lost.append(
            f'{file.name}: the last record is cut off after {survivors.left_over:,} bytes; what '
            'is whole in it was saved'
        )


def _connect(writer: Any, channel: Channel) -> Any:
    """Add a topic as it was, of a type that only the bag knows too."""
    from rosbags.rosbag2.storage_mcap import get_qos

    known = typestore() if channel.type in typestore().fielddefs else None
    return writer.add_connection(
        channel.topic,
        channel.type,
        typestore=known,
        msgdef=None if known else channel.definition,
        rihs01=None if known else 'unknown',
        offered_qos_profiles=get_qos(channel.metadata),
    )
