"""Where in a batch of pictures a layer of depth is, and what its light reaches."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from torch import Tensor


@dataclass(frozen=True)
class Place:
    """Where there is anything in a layer: items of a batch, and rows and columns (start, stop) of all of these."""

    items: tuple[int, ...]
    rows: tuple[int, int]
    columns: tuple[int, int]

    @staticmethod
    def of(rows: Tensor, columns: Tensor) -> list[Place | None]:
        """Those of layers, of whose rows (B, H, Z) and columns (B, W, Z) it is known whether there is something in
        them; None for each where there is nothing.
        """
        items = rows.any(1).cpu().numpy()
        ends = [_ends(side.any(0).cpu().numpy()) for side in (rows, columns)]
        return [
            Place(tuple(own.nonzero()[0].tolist()), *where) if own.any() else None
            for own, *where in zip(items.T, *ends, strict=True)
        ]

    def of_every(self, many: int, picture: tuple[int, int]) -> Place:
        """The same in a picture of which every so many rows and columns were looked at."""
        pairs = zip((self.rows, self.columns), picture, strict=True)
        rows, columns = ((many * start, min(n, many * stop)) for (start, stop), n in pairs)
        return Place(self.items, rows, columns)

    def box(self, window: tuple[int, int], picture: tuple[int, int]) -> tuple[tuple[int, int], tuple[int, int]]:
        """Rows and columns that light of it reaches through PSFs of a window, its mirror images at the borders too."""
        pairs = zip((self.rows, self.columns), window, picture, strict=True)
        found = [(max(0, start - m // 2), min(n, stop + m // 2)) for (start, stop), m, n in pairs]
        return found[0], found[1]


def _ends(filled: np.ndarray) -> list[tuple[int, int]]:
    """Of columns (N, Z), the first place that is filled, and the one after the last."""
    last = len(filled) - filled[::-1].argmax(0)
    return list(zip(filled.argmax(0).tolist(), last.tolist(), strict=True))
