"""Modules in files: weights as safetensors, and a configuration in JSON that a person can read. Nothing is pickled.

The configuration lives in the safetensors metadata. It names each module's class and its constructor arguments, which
every kcam module stores as attributes of the same name, or gives by a method ``configuration()``; ``cls(**arguments)``
rebuilds it. Tensors stand in the file under their module path, as in ``state_dict()``. Only classes that the reader's
table lists are ever built, and those of torch's layers that `kcam.layers` lists.

    {"class": "sensor.ReadNoise", "arguments": {"sigma_electrons": 3.0, "full_well": null}}

Numbers, strings, true, false and null are themselves; an infinite float is {"float": "inf"}; an array is a tuple; a
tensor is {"tensor": key, "shape": ...}, a parameter {"parameter": key, "shape": ..., "trainable": ...}; a module that
occurs again is {"same": path}. A layer of torch's also names its "tensors", and says "training": false where it is.
"""

from kcam.files.atomic import check_other, check_place, replace, replacing
from kcam.files.configuration import FIX as FIX
from kcam.files.configuration import NODES, fitting_arguments
from kcam.files.modules import FORMAT, describe, load, save

__all__ = [
    "FORMAT",
    "NODES",
    "check_other",
    "check_place",
    "describe",
    "fitting_arguments",
    "load",
    "replace",
    "replacing",
    "save",
]
