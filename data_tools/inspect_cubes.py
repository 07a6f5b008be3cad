"""Look at cubes before training on them: `kcam data inspect` as a script."""

from kcam.cli.console import run
from kcam.cli.data import inspect as main

if __name__ == "__main__":
    run(main)
