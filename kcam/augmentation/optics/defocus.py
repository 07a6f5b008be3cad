"""Defocus by wave optics: at one distance, or over a map of them."""

from __future__ import annotations

from typing import Unpack

import torch
from torch import Tensor

from kcam.augmentation.base import check_inverse_depth, wavelengths_of
from kcam.augmentation.distributions import Bounds, Draw, Uniform
from kcam.augmentation.optics.blur import FOCAL_LENGTH, BlurOptions, RandomBlur
from kcam.compiled import uncompiled
from kcam.optics.rendering.depth import Layers, layer_shares
from kcam.optics.rendering.renderer import Renderer


class RandomDefocus(RandomBlur):
    """Defocus by wave optics: a thin lens focused at one distance, the picture at another, or at those of a depth map.

    W = V r^2 / 2,   V = 1 / distance - 1 / focus,   sensor at d = 1 / (1 / f - 1 / focus), aperture f / N

    With a map of inverse depth the picture is cut into `layers` layers, equally far apart in vergence, blurred and laid
    over each other from far to near, as `optics.Imaging` does. Such a map comes from `CameraSequential`, or as
    ``augment(image, inverse_depth=map)``, (B,1,H,W) or one number per sample (B,) [1/m], 0 at infinity.

    Args:      focus: distance in focus [m]. f_number: N > 0. distance: of the picture without a map [m]. Distances are
                   drawn uniformly in 1/m, inf allowed.
               focal_length: f [m]. pixel_pitch: [m]. By default a machine-vision camera, 8 mm with 4 um pixels.
               layers: of a depth map.
               Others: as for `kcam.augmentation.optics.RandomBlur`.
    Raises:    ValueError for bounds out of range, a focus inside the focal length; at the call for a map of another
        shape or below 0.
    Valid      where `batch_psf` is: paraxial, 1 % where a^4 / (8 d^3 lambda) is below 0.005 waves.

    Example:
    >>> point = torch.zeros(1, 3, 33, 33)
    >>> point[..., 16, 16] = 1.0
    >>> near, far = (KC.RandomDefocus(focus=2.0, distance=z, f_number=4.0, p=1.0)(point).amax() for z in (1.9, 0.5))
    >>> bool(near > far)  # what is farther out of focus is spread more
    True
    """

    takes_depth = True

    def __init__(
        self,
        focus: Bounds = (0.5, 5.0),
        f_number: Bounds = (1.8, 8.0),
        *,
        distance: Bounds = (0.5, 5.0),
        focal_length: Bounds = FOCAL_LENGTH,
        layers: int = 8,
        **options: Unpack[BlurOptions],
    ) -> None:
        draws: dict[str, Draw] = {
            "focus": Uniform(focus, "vergence", least=1e-3, unit="[m]"),
            "f_number": Uniform(f_number, "log", least=0.5, most=200.0),
            "distance": Uniform(distance, "vergence", least=1e-3, unit="[m]"),
            "focal_length": Uniform(focal_length, least=1e-4, most=10.0, unit="[m]"),
        }
        super().__init__(draws, **options)
        nearest, longest = self.bounds("focus")[0], self.bounds("focal_length")[1]
        if nearest <= longest:
            raise ValueError(
                f"focus {nearest:g} m is inside the focal length of {longest:g} m: no real image. Use "
                f"focus=({2 * longest:g}, ...) or a shorter focal_length."
            )
        if isinstance(layers, bool) or not isinstance(layers, int) or layers < 1:
            raise ValueError(f"layers must be a whole number of 1 or more, got {layers!r}.")
        self.layers = layers
        self.flags |= {"layers": layers}

    def widest(self, wavelengths: Tensor) -> float:
        """The blur of the widest aperture at the worst of the distances, or the diffraction of the narrowest."""
        low, high = (1 / bound for bound in self.bounds("distance"))
        shortest, longest = self.bounds("focal_length")
        near, far = (1 / bound for bound in self.bounds("focus"))
        most = max(abs(end - focus) for end in (low, high) for focus in (near, far))
        sensor_distance = 1 / (1 / longest - near)
        widths = []
        for number in self.bounds("f_number"):
            blur = longest / (2 * number) * most * sensor_distance
            radius = shortest / (2 * number)
            widths.append(blur + self.tail(radius=radius, sensor_distance=sensor_distance, wavelengths=wavelengths))
        return max(widths)

    def half_width(
        self, drawn: dict[str, Tensor], wavelengths: Tensor, between: tuple[float, float] | None = None
    ) -> float:
        """Rays and diffraction of this lens, for objects at its distance, or at two vergences and between [1/m]."""
        focal, focus, number, distance = (
            float(drawn[name].detach()) for name in ("focal_length", "focus", "f_number", "distance")
        )
        radius, sensor_distance = focal / (2 * number), 1 / (1 / focal - 1 / focus)
        most = max(abs(vergence - 1 / focus) for vergence in between or (1 / distance,))
        tail = self.tail(radius=radius, sensor_distance=sensor_distance, wavelengths=wavelengths)
        return radius * most * sensor_distance + tail

    def psfs(self, drawn: dict[str, Tensor], *, wavelengths: Tensor, shape: tuple[int, int], like: Tensor) -> Tensor:
        """(B, 1, L, h, w), or (B, Z, L, h, w) for drawn["vergences"] (B, Z)."""
        focal, focus = drawn["focal_length"].double(), drawn["focus"].double()
        at = drawn["vergences"] if "vergences" in drawn else 1 / drawn["distance"].double()[:, None]
        return self.bank(
            at - 1 / focus[:, None].to(at.device),
            radii=focal / (2 * drawn["f_number"].double()),
            sensor_distance=1 / (1 / focal - 1 / focus),
            wavelengths=wavelengths,
            shape=shape,
            like=like,
        )

    def simulate(self, signal: Tensor, drawn: dict[str, Tensor]) -> Tensor:
        """One depth at once; with a map sample by sample, layer by layer."""
        if "inverse_depth" not in drawn:
            return super().simulate(signal, drawn)
        depth = check_inverse_depth(drawn["inverse_depth"], signal).double()
        rows = []
        for index in range(len(signal)):
            row = slice(index, index + 1)
            own = {name: value[row] for name, value in drawn.items()} | {"inverse_depth": depth[row]}
            vergences, psfs = self.layered(signal[row], own)
            low, high = vergences[0], vergences[-1]
            shares = None if len(vergences) == 1 or low == high else layer_shares(depth[row], vergences).to(signal)
            layers = Layers(signal[row], shares)
            renderer = Renderer(psfs, spectra=None, weights=None, picture=(signal.shape[-2], signal.shape[-1]))
            layers.add(renderer, first=0)
            rows.append(layers.light)
        return torch.cat(rows)

    @uncompiled
    def layered(self, signal: Tensor, drawn: dict[str, Tensor]) -> tuple[Tensor, Tensor]:
        """For one sample and its map: vergences of the layers (Z,) [1/m], and their PSFs (Z, L, h, w).

        The window is that of this map, which may reach beyond the range of distances.
        """
        low, high = drawn["inverse_depth"].aminmax()
        share = torch.linspace(0, 1, self.layers, dtype=low.dtype, device=low.device)
        vergences = low + (high - low) * (share if self.layers > 1 else share + 0.5)
        wavelengths = wavelengths_of(signal, self.wavelengths)
        half_width = self.half_width(drawn, wavelengths, (float(low.detach()), float(high.detach())))
        shape = self.window((signal.shape[-2], signal.shape[-1]), half_width)
        drawn = drawn | {"vergences": vergences[None]}
        return vergences, self.psfs(drawn, wavelengths=wavelengths, shape=shape, like=signal)[0]
