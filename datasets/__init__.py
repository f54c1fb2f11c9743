"""Fronts of `fgloc.datasets`, so that ``python -m datasets.NAME`` runs from a clone; not in the wheel."""
