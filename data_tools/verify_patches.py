"""Check a patch store: `kcam data verify` as a script."""

from kcam.cli.console import run
from kcam.cli.data import verify as main

if __name__ == "__main__":
    run(main)
