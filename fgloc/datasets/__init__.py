"""Loaders of public data sets into bags, the physical simulator, and small bundled recordings."""
