"""``python -m bfsensor COMMAND``."""

from bfsensor.cli.main import main

if __name__ == "__main__":
    main(prog_name="bfsensor")
