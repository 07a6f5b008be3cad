"""Convert spectral cubes, arrays or photographs into cube files: `kcam data convert` as a script."""

from kcam.cli.console import run
from kcam.cli.data import convert as main

if __name__ == "__main__":
    run(main)
