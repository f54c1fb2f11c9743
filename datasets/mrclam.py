"""``python -m datasets.mrclam``: ``fgloc convert mrclam`` from a clone."""

from fgloc.cli import main

if __name__ == "__main__":
    main("convert", "mrclam")
