"""``python -m training.train``: see `fgloc.training.train`."""

from fgloc.training.train import main

if __name__ == "__main__":
    raise SystemExit(main())
