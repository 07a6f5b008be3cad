"""Write one split of a patch store as HDF5 or Zarr: `kcam data export` as a script."""

from kcam.cli.console import run
from kcam.cli.data import export as main

if __name__ == "__main__":
    run(main)
