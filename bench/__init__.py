"""Benchmarks: everything one waits for, beside what one would use instead."""
