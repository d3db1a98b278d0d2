"""Memory and processor time that the processes of a live graph take, over time."""

from __future__ import annotations

from dataclasses import dataclass, field
import time

import numpy as np
import psutil

MEBIBYTE = 2.0**20


@dataclass
class Footprint:
    """
    Samples of the processes of a graph; hand it to `run_live` as `watch`.

    period: time between samples [s]. times: [s] since the first. memory: what each node allocated
    and touched [bytes]. cpu: processor time by node since its start [s].
    """

    period: float = 1.0
    times: list[float] = field(default_factory=list)
    memory: dict[str, list[int]] = field(default_factory=dict)
    cpu: dict[str, list[float]] = field(default_factory=dict)
    _begin: float = 0.0
    _processes: dict[str, psutil.Process] = field(default_factory=dict)

    def __call__(self, ids: dict[str, int]) -> None:
        """Take a sample if one is due; a process that is ending ends its samples."""
        now = time.monotonic()
        self._begin = self._begin or now
        if self.times and now - self._begin < self.times[-1] + self.period:
            return
        self._processes = self._processes or {n: psutil.Process(i) for n, i in ids.items()}
        try:
            taken = {name: _taken(process) for name, process in self._processes.items()}
        except (psutil.NoSuchProcess, psutil.AccessDenied):
            return
        self.times.append(now - self._begin)
        for name, (memory, cpu) in taken.items():
            self.memory.setdefault(name, []).append(memory)
            self.cpu.setdefault(name, []).append(cpu)

    def load(self, node: str) -> np.ndarray:
        """(N - 1,) processor time per time between samples; 1 is one core."""
        return np.diff(self.cpu[node]) / np.diff(self.times)

    def mean_load(self, node: str) -> float:
        """Processor time per time over all samples; 1 is one core."""
        cpu = self.cpu[node]
        return (cpu[-1] - cpu[0]) / (self.times[-1] - self.times[0])


def _taken(process: psutil.Process) -> tuple[int, float]:
    with process.oneshot():
        used, memory = process.cpu_times(), process.memory_info()
        # Not the unique set size: a library counts to it from when the last other program that had
        # it loaded ends, 85 MiB at once for Open3D.
        return memory.rss - memory.shared, used.user + used.system
