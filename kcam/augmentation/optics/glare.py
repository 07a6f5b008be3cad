"""Light that a lens scatters over the whole picture."""

from __future__ import annotations

import torch
from torch import Tensor

from kcam.augmentation.base import CameraAugmentation, wavelengths_of
from kcam.augmentation.distributions import Bounds, Draw, Uniform
from kcam.augmentation.optics.blur import DESIGN, FOCAL_LENGTH, FOCAL_LENGTH_RANGE, PIXEL_PITCH
from kcam.compiled import uncompiled
from kcam.optics import scattered_share, veiling_glare
from kcam.units import check_length, check_pixel_pitch, wavelength_grid


class RandomVeilingGlare(CameraAugmentation):
    """Light that the lens scatters over the picture, blue more than red: `optics.veiling_glare`.

    Args:      share: of the light that is scattered at 550 nm, 0 to 0.9: 0.01 of a clean prime, 0.1 of a fingerprint.
               core: shoulder of Harvey's law [direction cosine, about rad], drawn uniformly in its logarithm.
               slope: of its tail, 0.1 to 6.
               focal_length, pixel_pitch: [m]; by default a machine-vision camera, 8 mm with 4 um pixels.
               wavelengths: of the channels [m]; None: see `base`.
    Raises:    ValueError for bounds out of range, lengths that are not in metres, or too few wavelengths.

    Example:
    >>> picture = torch.ones(1, 3, 64, 64)
    >>> picture[..., 24:40, 24:40] = 0.0
    >>> hazy = KC.RandomVeilingGlare(share=0.1, core=0.003, slope=2.0, p=1.0)(picture)
    >>> bool(hazy[0, 2, 32, 32] > hazy[0, 0, 32, 32] > 0.2)  # the black of a white wall is a bluish gray
    True
    """

    alone = True

    def __init__(
        self,
        share: Bounds = (0.005, 0.08),
        core: Bounds = (0.002, 0.02),
        slope: Bounds = (1.6, 2.4),
        *,
        focal_length: float = FOCAL_LENGTH,
        pixel_pitch: float = PIXEL_PITCH,
        wavelengths: Tensor | list[float] | None = None,
        same_on_batch: bool = False,
        p: float = 0.5,
        keepdim: bool = False,
    ) -> None:
        draws: dict[str, Draw] = {
            "share": Uniform(share, least=0.0, most=0.9),
            "core": Uniform(core, "log", least=1e-6, most=1.0, unit="[rad]"),
            "slope": Uniform(slope, least=0.1, most=6.0),
        }
        super().__init__(draws, same_on_batch=same_on_batch, p=p, keepdim=keepdim)
        self.focal_length = check_length(
            focal_length, name="focal_length", within=FOCAL_LENGTH_RANGE, example="50 * mm"
        )
        self.pixel_pitch = check_pixel_pitch(pixel_pitch)
        self.flags = {"focal_length": self.focal_length, "pixel_pitch": self.pixel_pitch}
        self.wavelengths = None if wavelengths is None else wavelength_grid(wavelengths)

    @uncompiled  # the compiler has no code for complex numbers
    def simulate(self, signal: Tensor, drawn: dict[str, Tensor]) -> Tensor:
        """Row by row, each channel with a tail of its own."""
        wavelengths, reach = wavelengths_of(signal, self.wavelengths), self.focal_length / self.pixel_pitch
        rows = []
        for row, share, core, slope in zip(signal.split(1), drawn["share"], drawn["core"], drawn["slope"], strict=True):
            shares = scattered_share(share, wavelengths.to(share.device), reference=DESIGN)
            cores = core.double() * reach * (wavelengths.to(core.device) / DESIGN)
            rows.append(veiling_glare(row, share=shares, core=cores, slope=slope, reach=reach))
        return torch.cat(rows)
