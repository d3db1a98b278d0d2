"""
Recording and reading a bag, beside mcap with mcap-ros2-support.

`run(quick)` gives rows on one core, alternating the two, over the engine robot's measurements at
full sensor rate (16 ToF of 64 zones, gyros, strain, encoder, and the true poses), seconds per
second of data:
- *bag written*: ours from measurements, converted to messages on the way; the peer is given
  finished messages and has only to serialise and write them. Neither compresses.
- *bag read*: a bag of ours read by both; ours gives checked measurements, the peer messages.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import fields, is_dataclass
from pathlib import Path
import shutil
import tempfile
from typing import Any

from bench.harness import one_core, paired, seconds_of
from continuum_loc.offline.trials import simulate, Trial, write_bag
from msg_tools.bag import read_bag
from msg_tools.factory import bag_messages, typestore
from msg_tools.topics import topic_of, topic_spec
import numpy as np

PEER = 'mcap-ros2-support'


def run(quick: bool = False) -> list[dict]:
    """Rows of name, ours_s, peer, peer_s (per second of data), ratio and spread."""
    duration, repeats = (4.0, 3) if quick else (20.0, 7)
    samples = list(simulate(Trial('engine', 'S0', 't2', duration=duration)))
    messages = list(_messages(samples))
    folder = Path(tempfile.mkdtemp())
    try:
        with one_core():
            return [
                _written(folder, samples, messages, duration, repeats),
                _read(folder, samples, duration, repeats),
            ]
    finally:
        shutil.rmtree(folder)


def _messages(samples: list) -> Iterator[tuple[str, str, int, Any]]:
    """(topic, type, stamp, message) of each sample."""
    make = bag_messages()
    for sample in samples:
        topic = topic_of(sample)
        spec = topic_spec(topic)
        yield topic, spec.type, sample.stamp, _plain(spec.encode(make, sample))


def _plain(value: Any) -> Any:
    """Turn a message into what mcap-ros2-support takes: mappings, bytes and lists."""
    if isinstance(value, np.ndarray):
        return value.tobytes() if value.dtype == np.uint8 else value.tolist()
    if isinstance(value, list):
        return [_plain(item) for item in value]
    if is_dataclass(value):
        return {field.name: _plain(getattr(value, field.name)) for field in fields(value)}
    return value


def _written(folder: Path, samples: list, messages: list, duration: float, repeats: int) -> dict:
    def ours() -> None:
        shutil.rmtree(folder / 'ours', ignore_errors=True)
        write_bag(folder / 'ours', samples)

    def theirs() -> None:
        from mcap.writer import CompressionType
        from mcap_ros2.writer import Writer

        with (folder / 'theirs.mcap').open('wb') as stream:
            writer = Writer(stream, compression=CompressionType.NONE)
            schemas: dict[str, Any] = {}
            for topic, kind, stamp, message in messages:
                if kind not in schemas:
                    text, _ = typestore().generate_msgdef(kind, ros_version=2)
                    schemas[kind] = writer.register_msgdef(kind, text)
                writer.write_message(f'/{topic}', schemas[kind], message, stamp, stamp)
            writer.finish()

    return _compare('bag written', ours, theirs, duration, repeats)


def _read(folder: Path, samples: list, duration: float, repeats: int) -> dict:
    from mcap_ros2.reader import read_ros2_messages

    file = next((folder / 'ours').glob('*.mcap'))
    counts = {}

    def ours() -> None:
        counts['ours'] = sum(1 for _ in read_bag(folder / 'ours'))

    def theirs() -> None:
        counts['theirs'] = sum(1 for _ in read_ros2_messages(str(file)))

    row = _compare('bag read', ours, theirs, duration, repeats)
    if set(counts.values()) != {len(samples)}:
        raise RuntimeError(f'{len(samples)} messages written, read: {counts}')
    return row


def _compare(
    name: str,
    ours: Callable[[], None],
    theirs: Callable[[], None],
    duration: float,
    repeats: int,
) -> dict:
    ours(), theirs()
    times = [(seconds_of(ours), seconds_of(theirs)) for _ in range(repeats)]
    return paired(name, PEER, np.array(times) / duration)


if __name__ == '__main__':
    for row in run():
        print(row)
