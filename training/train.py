"""``python -m training.train``: ``fgloc train`` from a clone."""

from fgloc.cli import main

if __name__ == "__main__":
    main("train")
