"""``python -m datasets.sim``: see `fgloc.datasets.sim`."""

from fgloc.datasets.sim.command_line import run

if __name__ == "__main__":
    run()
