"""Entry point of ``python -m bfsensor COMMAND``, the same commands as ``bfsensor COMMAND``."""

from bfsensor.cli.main import main

if __name__ == "__main__":
    main(prog_name="bfsensor")
