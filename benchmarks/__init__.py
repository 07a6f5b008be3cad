"""Measurements of kcam against textbook computations: `python -m benchmarks.bench`."""

import os
import sys
from pathlib import Path

os.environ.setdefault("OMP_NUM_THREADS", "1")  # numpy's BLAS reads it once, when it is first imported
sys.path.append(str(Path(__file__).parents[1] / "tests"))  # oracles.py: the float64 truths that the tests use
