"""Light that falls off towards the corners."""

from __future__ import annotations

import math
import warnings

import torch
from torch import Tensor

from kcam.augmentation.base import CameraAugmentation, per_sample
from kcam.augmentation.distributions import Bounds, Draw, Uniform


class RandomVignetting(CameraAugmentation):
    """Light falls off towards the corners: cos^4 of the field angle, and less of the pupil is seen from the side.

    E / E_0 = cos^4(theta) (1 - shade u^2),   tan(theta) = u tan(field / 2),   u the distance from the centre, 1 at the
    corners

    Args:      field: full angle between opposite corners [degrees]; 47 is a 50 mm lens on full frame, 75 a phone.
               shade: share of the pupil that the corner does not see.
    Warns:     UserWarning for a field of at most pi degrees, which darkens no corner: it was probably meant in radians.
    Source:    the cos^4 law: Born and Wolf, Principles of Optics, section 4.8.

    Example:
    >>> white = torch.ones(1, 3, 65, 65)
    >>> corner = float(KC.RandomVignetting(field=60.0, shade=0.0, p=1.0)(white)[0, 0, 0, 0])
    >>> round(((corner + 0.055) / 1.055) ** 2.4, 2), round(math.cos(math.radians(30)) ** 4, 2)  # its light
    (0.56, 0.56)
    """

    alone = True

    def __init__(
        self,
        field: Bounds = (20.0, 80.0),
        shade: Bounds = (0.0, 0.4),
        *,
        same_on_batch: bool = False,
        p: float = 0.5,
        keepdim: bool = False,
    ) -> None:
        draws: dict[str, Draw] = {
            "field": Uniform(field, least=0.0, most=160.0, unit="[degrees]"),
            "shade": Uniform(shade, least=0.0, most=1.0),
        }
        super().__init__(draws, same_on_batch=same_on_batch, p=p, keepdim=keepdim)
        widest = float(torch.as_tensor(field).detach().max())
        if 0 < widest <= math.pi:
            darkened = 1 - math.cos(math.radians(widest) / 2) ** 4
            warnings.warn(
                f"a field of {widest:g} degrees darkens the corners by {darkened:.2%}. Angles are in degrees; did you "
                f"mean {math.degrees(widest):.3g}, which is {widest:g} rad?",
                stacklevel=2,
            )

    @staticmethod
    def falloff(shape: tuple[int, int], *, drawn: dict[str, Tensor], like: Tensor) -> Tensor:
        """(B,1,H,W), 1 at the centre."""
        height, width = shape
        y, x = (torch.arange(n, dtype=like.dtype, device=like.device) - (n - 1) / 2 for n in shape)
        corner = max(((height - 1) ** 2 + (width - 1) ** 2) / 4, 1e-12)
        u2 = (x[None, :] ** 2 + y[:, None] ** 2) / corner
        tangent = torch.tan(torch.deg2rad(per_sample(drawn["field"], like)) / 2)
        return (1 - per_sample(drawn["shade"], like) * u2) / (1 + tangent**2 * u2) ** 2

    def simulate(self, signal: Tensor, drawn: dict[str, Tensor]) -> Tensor:
        """All channels alike."""
        return signal * self.falloff((signal.shape[-2], signal.shape[-1]), drawn=drawn, like=signal)
