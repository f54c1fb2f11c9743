"""``python -m fgloc``."""

from fgloc.cli import main

if __name__ == "__main__":
    main()
