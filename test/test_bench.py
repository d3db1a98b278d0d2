"""
Benchmarks keep up with the code that they measure.

They run without their peers here, which only `continuum-loc bench` installs.
"""

from bench.harness import bench_names, load_benchmark, require_places
from continuum_loc import lie
from continuum_loc.estimator.settings import load_estimator_settings
from continuum_loc.offline.trials import measured, simulate, Trial, write_bag
from msg_tools.bag import read_bag
import numpy as np
import pytest


@pytest.mark.parametrize('name', bench_names())
def test_a_benchmark_loads_and_its_table_has_a_place_in_the_document(name):
    assert callable(load_benchmark(name).run)
    require_places([name])


def test_the_chain_given_to_gtsam_is_solved_to_the_motion_it_was_made_of():
    window = load_benchmark('window')
    problem = window._temporal_problem()
    T = window._gauss_newton(problem)
    true = lie.exp(np.arange(window.KNOTS)[:, None] * problem.period * window.TWIST)

    def furthest(poses):
        return np.abs(lie.log(lie.inverse(true) @ poses)).max()

    assert furthest(T) < 0.01 < furthest(problem.guess)  # a frame is off by 0.001, a guess by 0.05


def test_both_writers_of_a_bag_get_every_sample(tmp_path):
    bags = load_benchmark('bags')
    samples = list(simulate(Trial('engine', 'S0', 't2', duration=0.2)))
    messages = list(bags._messages(samples))
    assert len(messages) == len(samples)
    assert {topic for topic, *_ in messages} >= {'tof/points', 'strain'}
    assert sum(write_bag(tmp_path / 'ours', samples).values()) == len(samples)
    assert sum(1 for _ in read_bag(tmp_path / 'ours')) == len(samples)


def test_cost_against_size_of_the_map_is_measured_for_a_step_and_for_a_lookup(monkeypatch):
    sizes = load_benchmark('sizes')
    monkeypatch.setattr(sizes, 'MAPS', (5_000, 20_000))
    samples = measured(Trial('engine', 'S0', 't2', duration=sizes.SETTLED + 0.2))
    rows = sizes._maps(samples, load_estimator_settings('engine'), quick=True)
    assert [row['size'] for row in rows] == [5_000, 20_000] * 2
    assert all(row['ours_s'] > 0.0 and np.isfinite(row['exponent']) for row in rows)
    assert rows[0]['memory_bytes'] < rows[1]['memory_bytes']
