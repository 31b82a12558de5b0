"""Benchmarks: ``python -m benchmarks [NAME ...]`` prints the tables of ``docs/benchmarks.md``.

Each compares with a baseline measured in the same run, interleaved with it, and prints ratios.
"""
