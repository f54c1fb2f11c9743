"""Front of `fgloc.datasets.sim`."""
