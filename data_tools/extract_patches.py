"""Cut cubes into a store of patches to train on: `kcam data extract` as a script."""

from kcam.cli.console import run
from kcam.cli.data import extract as main

if __name__ == "__main__":
    run(main)
