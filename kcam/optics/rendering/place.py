"""Where in a batch of pictures a layer of depth is, and what its light reaches."""

from __future__ import annotations

from dataclasses import dataclass

from torch import Tensor


@dataclass(frozen=True)
class Place:
    """Where there is anything in a layer: items of a batch, and rows and columns (start, stop) of all of these."""

    items: tuple[int, ...]
    rows: tuple[int, int]
    columns: tuple[int, int]

    @classmethod
    def of(cls, rows: Tensor, columns: Tensor) -> Place | None:
        """That of rows (B, H) and columns (B, W) in which there is something, bool; None where there is nothing."""
        items = rows.any(1).nonzero().flatten().tolist()
        if not items:
            return None
        sides = [side.any(0).nonzero().flatten() for side in (rows, columns)]
        return cls(tuple(items), *((int(side[0]), int(side[-1]) + 1) for side in sides))

    def box(self, window: tuple[int, int], picture: tuple[int, int]) -> tuple[tuple[int, int], tuple[int, int]]:
        """Rows and columns that light of it reaches through PSFs of a window, its mirror images at the borders too."""
        pairs = zip((self.rows, self.columns), window, picture, strict=True)
        found = [(max(0, start - m // 2), min(n, stop + m // 2)) for (start, stop), m, n in pairs]
        return found[0], found[1]
