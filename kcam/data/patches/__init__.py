"""A store of patches that trains fast and can be trusted: one memory-mapped uint16 array per scene, and a manifest.

    patches/train/manifest.json
    patches/train/scenes/<scene>.npy       (N, L, size, size) uint16; value = number * scale, scale in the manifest
    patches/val/...

Whatever the folder, the time, the machine, the number of workers, the shards or the interruptions, the bytes are the
same. While it is being made, a folder .work holds a plan and a record of each scene that is done; the end removes it.
"""

from kcam.data.patches.manifest import MANIFEST, read_manifest
from kcam.data.patches.plan import Settings, StoreError, group_of, make_plan, parse_split, positions, split_of
from kcam.data.patches.store import StoreStopped, extract
from kcam.data.patches.verification import verify

__all__ = [
    "MANIFEST", "Settings", "StoreError", "StoreStopped", "extract", "group_of", "make_plan", "parse_split",
    "positions", "read_manifest", "split_of", "verify",
]  # fmt: skip
