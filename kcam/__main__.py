"""``python -m kcam``: the same as the command `kcam`."""

from kcam.cli import main

if __name__ == "__main__":
    main()
