"""``python -m datasets.pioneer``: ``fgloc convert pioneer`` from a clone."""

from fgloc.cli import main

if __name__ == "__main__":
    main("convert", "pioneer")
