"""``python -m datasets.sim``: ``fgloc sim`` from a clone."""

from fgloc.cli import main

if __name__ == "__main__":
    main("sim")
