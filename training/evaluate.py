"""``python -m training.evaluate``: see `fgloc.training.evaluate`."""

from fgloc.training.evaluate import main

if __name__ == "__main__":
    raise SystemExit(main())
