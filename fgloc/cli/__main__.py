"""``python -m fgloc.cli``."""

from fgloc.cli import main

if __name__ == "__main__":
    main()
