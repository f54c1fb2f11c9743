"""Benchmarks: ``python -m benchmarks.NAME [--quick] [--json FILE]`` prints id, value, spread, n, unit."""
