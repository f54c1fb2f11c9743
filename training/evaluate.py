"""``python -m training.evaluate``: ``fgloc evaluate-model`` from a clone."""

from fgloc.cli import main

if __name__ == "__main__":
    main("evaluate-model")
