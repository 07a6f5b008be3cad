"""Lens distortion, which moves pixels: masks, boxes and keypoints go with them."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import kornia.augmentation as K
import torch
from kornia.constants import Resample
from kornia.core.ops import eye_like
from kornia.geometry.boxes import Boxes
from kornia.geometry.calibration import distort_points, undistort_points
from kornia.geometry.keypoints import Keypoints
from kornia.geometry.transform import remap
from torch import Tensor

from kcam.augmentation.base import Checked, check_probability, check_values, is_picture, on_drawn_rows
from kcam.augmentation.distributions import Bounds, Draw, Draws, Uniform
from kcam.optics.numerics import chebyshev_between, lagrange_weights
from kcam.precision import full_precision

_ITERATIONS = 40  # of the inverse, a fixed point, at most
_TOLERANCE = 0.01  # of the inverse, at probes all over the picture [pixels]
_NODES = 20  # on a side of the picture, through which a polynomial goes
_EDGE_SAMPLES = 9  # of a box's edge: a straight edge becomes a curve


class MovedPixels(Checked, K.GeometricAugmentationBase2D):
    """Base of the augmentations whose lens moves pixels. A subclass says where to in `_moved` and `_remapped`.

    Keypoints move exactly; a box becomes the box around its moved edges.
    """

    def _moved(self, points: Tensor, params: dict[str, Tensor], *, inverse: bool) -> Tensor:
        """Points (B, ..., 2) in pixels to where the lens images them, or from there."""
        raise NotImplementedError(f"{type(self).__name__} does not say where points go.")

    def _remapped(self, input: Tensor, params: dict[str, Tensor], flags: dict[str, Any], *, inverse: bool) -> Tensor:
        """Each pixel of (B,C,H,W) from where the ideal lens has it, or from where this one images it."""
        raise NotImplementedError(f"{type(self).__name__} does not say where pixels go.")

    def compute_transformation(self, input: Tensor, params: dict[str, Tensor], flags: dict[str, Any]) -> Tensor:
        """No matrix can say what happens; Kornia's is the identity."""
        return eye_like(3, input)

    def inverse_inputs(
        self, input: Tensor, params: dict[str, Tensor], flags: dict[str, Any], transform: Tensor | None = None, **kwargs
    ) -> Tensor:
        """The picture of the ideal lens again, but for what was resampled twice or lay outside."""
        picture = self.transform_tensor(input)
        gate = self._gate(params).to(picture.device)[:, None, None, None]
        return torch.where(gate, self._remapped(picture, params, flags | kwargs, inverse=True), picture)

    def apply_transform_keypoint(
        self, input: Keypoints, params: dict[str, Tensor], flags: dict[str, Any], transform: Tensor | None = None
    ) -> Keypoints:
        """Each point to where the lens images it."""
        return self._moved_keypoints(input, params, inverse=False)

    def inverse_keypoints(
        self,
        input: Keypoints,
        params: dict[str, Tensor] | None,
        flags: dict[str, Any],
        transform: Tensor | None = None,
        **kwargs,
    ) -> Keypoints:
        """Each point to where the ideal lens images it."""
        params = self._params if params is None else params
        moved = self._moved_keypoints(input, params, inverse=True)
        moved._data = self._blend_by_prob(moved.data, input.data, self._gate(params))
        return moved

    def inverse_boxes(
        self,
        input: Boxes,
        params: dict[str, Tensor] | None,
        flags: dict[str, Any],
        transform: Tensor | None = None,
        **kwargs,
    ) -> Boxes:
        """The upright box around the edges where the ideal lens images them."""
        params = self._params if params is None else params
        moved = self._moved_boxes(input, params, inverse=True)
        moved._data = self._blend_by_prob(moved.data, input.data, self._gate(params))
        return moved

    def apply_transform_box(
        self, input: Boxes, params: dict[str, Tensor], flags: dict[str, Any], transform: Tensor | None = None
    ) -> Boxes:
        """The upright box around the moved edges."""
        return self._moved_boxes(input, params, inverse=False)

    def _moved_keypoints(self, input: Keypoints, params: dict[str, Tensor], *, inverse: bool) -> Keypoints:
        output = input.clone()
        output._data = self._moved(input.data, params, inverse=inverse).to(input.data.dtype)
        return output

    def _moved_boxes(self, input: Boxes, params: dict[str, Tensor], *, inverse: bool) -> Boxes:
        corners = input.data  # (B, N, 4, 2) in turn around the box
        share = torch.linspace(0, 1, _EDGE_SAMPLES, dtype=corners.dtype, device=corners.device)[:, None]
        edges = corners[..., None, :] + (corners.roll(-1, dims=-2) - corners)[..., None, :] * share
        moved = self._moved(edges.flatten(1, -2), params, inverse=inverse)
        moved = moved.to(corners.dtype).view(*edges.shape[:2], -1, 2)
        (left, top), (right, bottom) = moved.amin(-2).unbind(-1), moved.amax(-2).unbind(-1)
        output = input.clone()
        output._data = torch.stack(
            [torch.stack(point, -1) for point in ((left, top), (right, top), (right, bottom), (left, bottom))], dim=-2
        )
        return output


class SmoothlyMoved(MovedPixels):
    """Base of those for which a subclass says in `_through` where any points go, smoothly; it draws by Draws."""

    takes_alpha = True
    _param_generator: Draws

    def __init__(self, draws: dict[str, Draw], *, resample: str, same_on_batch: bool, p: float, keepdim: bool) -> None:
        check_probability(p)
        if resample not in ("bilinear", "nearest"):
            raise ValueError(f'resample must be "bilinear" or "nearest", got {resample!r}.')
        super().__init__(p=p, same_on_batch=same_on_batch, p_batch=1.0, keepdim=keepdim)
        self._param_generator = Draws(draws)
        self.flags = {"resample": Resample.get(resample), "align_corners": True}

    def apply_transform(
        self, input: Tensor, params: dict[str, Tensor], flags: dict[str, Any], transform: Tensor | None = None
    ) -> Tensor:
        """The picture: each pixel from where the ideal lens has it."""

        def effect(rows: Tensor, own: dict[str, Tensor]) -> Tensor:
            if rows.numel():
                check_values(rows, picture=is_picture(rows) and "linear" not in params)
            return self._remapped(rows, own, flags, inverse=False)

        drawn = {name: params[name] for name in self._param_generator.draws}
        return on_drawn_rows(input, params, drawn, effect, p=self.p)

    def apply_transform_mask(
        self, input: Tensor, params: dict[str, Tensor], flags: dict[str, Any], transform: Tensor | None = None
    ) -> Tensor:
        """As a picture, with resample nearest, and any values: of classes, or of a depth that is NaN here and there."""
        drawn = {name: params[name] for name in self._param_generator.draws}
        return on_drawn_rows(
            input, params, drawn, lambda rows, own: self._remapped(rows, own, flags, inverse=False), p=self.p
        )

    def _moved(self, points: Tensor, params: dict[str, Tensor], *, inverse: bool) -> Tensor:
        """Points (B, ..., 2) in pixels to where the lens images them, or from there."""
        if points.numel() == 0:
            return points
        height, width = params["forward_input_shape"][-2:].tolist()
        flat = points.double().flatten(1, -2)
        return self._through(flat, params, (height, width), inverse=inverse).view(points.shape)

    def _through(self, points: Tensor, params: dict[str, Tensor], shape: tuple[int, int], *, inverse: bool) -> Tensor:
        """Points (B,N,2) float64 of a picture of that shape to where they are imaged, or from there."""
        raise NotImplementedError(f"{type(self).__name__} does not say where points go.")

    def _remapped(self, input: Tensor, params: dict[str, Tensor], flags: dict[str, Any], *, inverse: bool) -> Tensor:
        if input.numel() == 0:
            return input
        working = input if input.dtype in (torch.float32, torch.float64) else input.float()
        shape = working.shape[-2], working.shape[-1]

        def move(points: Tensor) -> Tensor:
            return self._through(points.expand(len(working), -1, -1), params, shape, inverse=not inverse)

        with full_precision(working.device):
            across, down = _moved_pixels(shape, move, working).unbind(1)
            mode = Resample.get(flags.get("resample", Resample.BILINEAR)).name.lower()
            return remap(working, across, down, mode=mode, align_corners=True).to(input.dtype)


class RandomLensDistortion(SmoothlyMoved):
    """Barrel and pincushion distortion: the Brown-Conrady model, with OpenCV's coefficients.

    x_d = x (1 + k1 r^2 + k2 r^4) + 2 p1 x y + p2 (r^2 + 2 x^2),   y_d = y (1 + ...) + p1 (r^2 + 2 y^2) + 2 p2 x y

    with (x, y) the position from the picture's centre in units of `focal_length` times its longer side. What an ideal
    lens images at (x, y) this one images at (x_d, y_d). Masks are taken from the nearest pixel; keypoints move exactly;
    a box becomes the box around its moved edges. Beyond the picture it is black, and masks are 0.

    Args:      k1: below 0 barrel, above 0 pincushion. k2: its next term. p1, p2: decentring.
               focal_length: of the lens in units of the picture's longer side; 1 is a field of 53 degrees.
               resample: of the picture, "bilinear" or "nearest".
    Raises:    ValueError at the call where the drawn coefficients fold the picture over itself, or nearly so (the
        inverse does not converge to 0.01 pixels).
    Source:    Brown, Photogrammetric Engineering 32, 444 (1966); OpenCV's calib3d.

    Example:
    >>> warped = KC.RandomLensDistortion(k1=-0.2, p=1.0)(torch.ones(1, 3, 65, 65))[0, 0]  # barrel
    >>> float(warped[32, 32]), float(warped[0, 0])  # the corners move in, and leave black
    (1.0, 0.0)
    """

    def __init__(
        self,
        k1: Bounds = (-0.2, 0.2),
        k2: Bounds = 0.0,
        p1: Bounds = 0.0,
        p2: Bounds = 0.0,
        *,
        focal_length: float = 1.0,
        resample: str = "bilinear",
        same_on_batch: bool = False,
        p: float = 0.5,
        keepdim: bool = False,
    ) -> None:
        values = {"k1": k1, "k2": k2, "p1": p1, "p2": p2}
        draws: dict[str, Draw] = {name: Uniform(bounds, least=-10.0, most=10.0) for name, bounds in values.items()}
        super().__init__(draws, resample=resample, same_on_batch=same_on_batch, p=p, keepdim=keepdim)
        if not focal_length > 0:
            raise ValueError(f"focal_length must be > 0 of the picture's longer side, got {focal_length:g}.")
        self.flags |= {"focal_length": focal_length}
        self.focal_length = focal_length

    def generate_parameters(self, batch_shape: tuple[int, ...]) -> dict[str, Tensor]:
        """What is drawn, refused where it folds the picture."""
        drawn = super().generate_parameters(batch_shape)
        height, width = batch_shape[-2:]
        if batch_shape[0] and not torch.compiler.is_compiling():
            with torch.no_grad():
                camera, coefficients = self._lens(drawn, (height, width), torch.device("cpu"))
                probes = _probes((height, width)).expand(len(coefficients), -1, -1)
                ideal = undistort_points(probes, camera, coefficients, num_iters=_ITERATIONS)
                missed = (distort_points(ideal, camera, coefficients) - probes).abs().amax((1, 2))
            bad = ~(missed < _TOLERANCE)
            if bad.any():
                k1, k2, p1, p2 = coefficients[bad][0].tolist()
                raise ValueError(
                    f"k1 = {k1:.3g}, k2 = {k2:.3g}, p1 = {p1:.3g}, p2 = {p2:.3g} fold the picture over itself, or "
                    f"nearly so: some pixels have no one point that is imaged there. Use coefficients of half the "
                    f"size, or focal_length={1.5 * self.focal_length:.3g}."
                )
        return drawn

    def _lens(self, params: dict[str, Tensor], shape: tuple[int, int], device: torch.device) -> tuple[Tensor, Tensor]:
        """Camera matrices (B,3,3) and coefficients (B,4), float64."""
        height, width = shape
        coefficients = torch.stack([params[name].double().to(device) for name in ("k1", "k2", "p1", "p2")], dim=1)
        focal = self.focal_length * max(height, width)
        camera = torch.tensor(
            [[focal, 0.0, (width - 1) / 2], [0.0, focal, (height - 1) / 2], [0.0, 0.0, 1.0]], dtype=torch.float64
        )
        return camera.to(device).expand(len(coefficients), 3, 3), coefficients

    def _through(self, points: Tensor, params: dict[str, Tensor], shape: tuple[int, int], *, inverse: bool) -> Tensor:
        """Points (B,N,2) float64 of a picture of that shape."""
        camera, coefficients = self._lens(params, shape, points.device)
        if inverse:
            return undistort_points(points, camera, coefficients, num_iters=_ITERATIONS)
        return distort_points(points, camera, coefficients)


def _moved_pixels(shape: tuple[int, int], move: Callable[[Tensor], Tensor], like: Tensor) -> Tensor:
    """Where all pixels of a picture move to, (B,2,H,W) as x, y, in the dtype of `like`.

    move: float64 points (1,N,2) as x, y to (B,N,2), smoothly: it is asked for `_NODES`^2 points, and polynomials go
    through these; for all pixels where that is off by 1e-4 pixels at probes, in small pictures and to torch.compile.
    """
    grid = [torch.arange(n, dtype=torch.float64, device=like.device) for n in (shape[1], shape[0])]
    if shape[0] * shape[1] > 4 * _NODES**2 and not torch.compiler.is_compiling():
        nodes = [chebyshev_between(pixels[0], pixels[-1], _NODES) for pixels in grid]
        away = (move(torch.cartesian_prod(*nodes)[None]) - torch.cartesian_prod(*nodes)).unflatten(1, (_NODES, _NODES))
        probes = [torch.linspace(0, n - 1, 9, dtype=torch.float64, device=like.device) for n in (shape[1], shape[0])]
        between = [lagrange_weights(known, asked) for known, asked in zip(nodes, probes, strict=True)]
        found = torch.einsum("px,bxyc,qy->bpqc", between[0], away, between[1]).flatten(1, 2)
        missed = move(torch.cartesian_prod(*probes)[None]) - torch.cartesian_prod(*probes) - found
        if float(missed.detach().abs().max()) < 1e-4:
            across, down = (lagrange_weights(known, asked).to(like) for known, asked in zip(nodes, grid, strict=True))
            moved = down @ away.permute(0, 3, 2, 1).to(like) @ across.mT
            moved[:, 0] += grid[0].to(like)
            moved[:, 1] += grid[1].to(like)[:, None]
            return moved
    every = torch.cartesian_prod(grid[1], grid[0]).flip(-1)
    return move(every[None]).to(like).mT.unflatten(2, shape)


def _probes(shape: tuple[int, int]) -> Tensor:
    """Points of a picture's sides and of its inside, (81, 2) as x, y: decentred, a lens is at its worst anywhere."""
    height, width = shape
    return torch.cartesian_prod(*(torch.linspace(0, n - 1, 9, dtype=torch.float64) for n in (width, height)))
