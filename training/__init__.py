"""Fronts of `fgloc.training`, so that ``python -m training.NAME`` runs from a clone; not in the wheel."""
