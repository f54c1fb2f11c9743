"""Metrics, consistency, plots (the only matplotlib importer), report."""
