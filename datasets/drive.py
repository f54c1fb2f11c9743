"""``python -m datasets.drive``: ``fgloc convert drive`` from a clone."""

from fgloc.cli import main

if __name__ == "__main__":
    main("convert", "drive")
