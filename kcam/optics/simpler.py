"""What varies over a picture, with some of it left out: a plan's shortcuts, each by itself."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from kcam.optics.source import FieldPSFs, PixelGrid


@dataclass(frozen=True)
class SimplerField:
    """PSFs over the field as `source.FieldPSFs`, of optics that have no field variation, distortion or relative
    illumination: those of `Accuracy` that are False. It leaves out no lateral colour by itself.
    """

    psfs: FieldPSFs
    field_variation: bool = True
    distortion: bool = True
    relative_illumination: bool = True

    def bank(
        self,
        places: Tensor,
        pixels: PixelGrid,
        *,
        whole: bool = False,
        mixing: Tensor | None = None,
        mixed: bool = False,
        colours: float | None = None,
    ) -> Tensor:
        """Without field variation the PSF of the axis, with the light that each place has."""
        own = places if self.field_variation else torch.zeros_like(places[:1])
        found = self.psfs.bank(own, pixels, whole=whole, mixing=mixing, mixed=mixed, colours=colours)
        if self.field_variation and self.relative_illumination:
            return found
        factor = self.illumination(places) / self.psfs.illumination(own)
        return found * factor.to(found).view(-1, 1, 1, 1, 1)

    @property
    def fewer_colours(self) -> tuple[int, ...]:
        """Those of the optics."""
        return self.psfs.fewer_colours

    @property
    def mirrored(self) -> bool:
        """That of the optics."""
        return self.psfs.mirrored

    def illumination(self, places: Tensor) -> Tensor:
        """That of the optics, or 1 everywhere."""
        return self.psfs.illumination(places) if self.relative_illumination else torch.ones_like(places[..., 0])

    def undistorted(self, places: Tensor) -> Tensor:
        """Where a lens without distortion would bring what falls at places (..., 2) [m]."""
        return self.psfs.undistorted(places) if self.distortion else places

    def window(self, pixels: PixelGrid) -> tuple[int, int]:
        """That of the optics."""
        return self.psfs.window(pixels)

    def points(self, pixels: PixelGrid) -> float:
        """Those of the optics."""
        return self.psfs.points(pixels)

    def at_wavelengths(self, wavelengths: Tensor, *, lateral_colour: bool = True) -> SimplerField:
        """See `source.FieldPSFs`."""
        others = self.psfs.at_wavelengths(wavelengths, lateral_colour=lateral_colour)
        return SimplerField(others, self.field_variation, self.distortion, self.relative_illumination)

    def deviations(
        self, pixels: PixelGrid, *, mixing: Tensor | None = None, colours: float | None = None
    ) -> dict[str, float]:
        """Those of the optics: what is left out on purpose is not counted."""
        return self.psfs.deviations(pixels, mixing=mixing, colours=colours)
