"""What a linear choice changes in the noiseless raw, from spectra: no picture is rendered for it.

    E^2 = sum_f tr(D(f) C(f) D(f)^H),   D_rk = sum_l A_rl S_kl (H_l - G_l)

C are the cross-spectra of a scene's planes, in rings of frequency: mirrored at its borders, by a cosine transform, or
dark there. H and G are transfer functions, of which slices through the middle suffice: light that runs more along x
sees that along x. A^T A is what pixels record of each pair of bands, in their mean. With layers of depth each plane is
split among them, and each layer has transfer functions of its own; where there are fewer, those of its neighbours. What
layers hide of each other is off as their masks are in even light: by a part of the light that may be hidden, and by all
of it where that is much.
"""

from __future__ import annotations

import enum
import functools
import itertools
import math
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, replace
from typing import Any

import torch
from torch import Tensor
from torch.nn import functional

from kcam.camera import Camera
from kcam.optics import Imaging
from kcam.optics.imaging import is_deep
from kcam.optics.numerics import cubic_weights
from kcam.optics.rendering.depth import alike, layer_shares
from kcam.optics.rendering.renderer import Renderer
from kcam.planner.band_counts import FEW_BANDS
from kcam.planner.cross_spectra import InRings, in_rings
from kcam.planner.light import UNSEEN, blurred, compressed, contrast, few_lights, hues, lights, recorded
from kcam.planner.transfers import PARAXIAL, Transfers, Way
from kcam.scene import Scene

LINEAR = {"blur", "bands", "interpolate_bands", "psf_shape", "renormalise", "kappa", "propagator"}
LINEAR |= {"layers", "occlusion"}
"""Changes of an Imaging that act as transfer functions do, and that of what hides what."""

COLOURS = {"bands", "interpolate_bands"}
"""Of these, those of the wavelengths."""

WITH_PSFS = {"psf_shape", "renormalise", "kappa", "propagator"}
"""Of these, those whose error is that of the PSFs themselves, not of what they are computed for."""

WINDOW = {"psf_shape", "renormalise"}
"""Of those, those of the window alone."""

WHOLE = {"renormalise": True}
"""What masks are always blurred with: each covers as much as there is of it."""

TOLD_BY_LINES = WINDOW | {"propagator"}
"""These and others that line spreads tell roughly."""

_BETWEEN_PSFS, _BETWEEN_LIGHTS = 1.25, 1.5  # times the error of PSFs between others: what cubics leave is smaller than
# what slices tell of a PSF, or rows of a map: 0.75 to 1.24 times the truth of 157 without it (2 %, median), 0.56 of one
# picture at 0.001; of few lights behind maps of pixels, which show more of it
_HIDDEN = 1.2  # times the error without occlusion: at edges of depth what is hidden is not added up, but replaced
_HIDDEN_LIGHTS = 1.5  # the same of few lights
_OVER_LIGHTS = 7.0  # times that of fewer layers: a light between two of them is seen through masks as steep as itself
_SEEN_THROUGH = 3.0  # the same where something near is blurred wide, and what is behind it is not: little of that is
# left, which stands for all that is hidden; but of choices of wavelengths where few lights stand out: 3 to 12 times
# what they cost would be told of 16 such scenes
_SEEN_THROUGH_LIGHTS = 8.0  # of windows of a lamp that goes on behind it: told 0.4 times what they cost with 3
_WIDE = 1 / 8  # of the picture's shorter side, the radius of such a blur
_EDGES = 0.15  # of what masks say of hidden light, in energy: the rest is in the planes that they cut
_DROWNED = 1.3  # of `hidden`, from which on masks say more, up to all of it one further
_COLOURED = 2.0  # times what is beyond that, the energy that a choice of wavelengths errs more: masks are white
_UNLIKE_WHITE = 0.3  # of the light, that is in other bands than white has it, from which on it is seen at edges
_LOST = 0.75  # of the light that falls into the window from a layer, that does not from another, from which on
# they are not, and veil what is behind: wavelengths before 40 such scenes were told 1.1 times the truth and more
_MOST_VEILED = 0.9  # of what is behind
_MOST = 0.9  # of the light, that a window must hold through which it is looked at
_GOES_ON = 1.5  # times the energy that mirrors would give, of a picture whose borders are replicated
_OUTSIDE = 1.4  # times what products of line spreads say is lost beyond borders: 0.9 to 1.6 of 13 that lose 3 %
_FRAMED = 64  # pixels of the shorter side, of which there are as many again, that tell what falls into the picture
_BETWEEN_LAYERS = 4  # times as many layers as there are in a setting, between whose transfer functions its own lie
_SAME_LAYER = 1e-6  # of the range of depth


@dataclass(frozen=True)
class _Layered:
    """Of rows that are cut into the same layers: their vergences (Z,), and cross-spectra (B, 2, F, K Z, K Z) of light
    that runs along x, and y, or the diagonals; of many planes what these are made of, for each hue of each row.
    """

    vergences: Tensor
    light: Tensor | list[list[InRings]]


class Care(enum.Enum):
    """With how much an error is estimated."""

    FULL = enum.auto()
    ROUGH = enum.auto()  # of windows by line spreads, of models by these at one wavelength, of others at one wavelength
    AT_FIRST = enum.auto()  # of windows by line spreads of the whole, of which a smaller one is a part


class Spectra:
    """A batch of scenes as spectra, before optics and sums over the bands (R, L) that a sensor records, or all bands.

    scene: whose light may be of a few wavelengths of those that the optics are for. hidden: of each row, the energy of
    the light that something nearer may hide, of what is recorded, for each share of the pixels that is, (B,); None
    where that does not count. hues: planes (B, J, H, W) instead of the scene's, whose squares add up.
    """

    def __init__(
        self,
        optics: Transfers,
        scene: Scene,
        weights: Tensor | None,
        *,
        hidden: Tensor | None = None,
        hues: Tensor | None = None,
    ) -> None:
        self.optics, self.imaging, self.wavelengths = optics, optics.imaging, optics.wavelengths
        self.scene, self.weights, self.hidden, self.hues = scene, weights, hidden, hues
        self.frequencies = optics.frequencies
        groups = alike(scene)
        self.groups = [(rows, scene if len(groups) == 1 else scene.samples(rows.tolist())) for rows in groups]
        self._unlike = torch.ones(len(scene.coefficients), dtype=torch.float64)  # see `compare`
        self._framed = torch.ones_like(self._unlike)  # see `frame`
        self._layered: dict[tuple[int, Any], _Layered] = {}
        self._known: dict[tuple[Any, ...], Tensor] = {}
        self._energies_known: dict[tuple[Any, ...], Tensor] = {}

    @classmethod
    def of(
        cls, camera: Camera, imaging: Imaging, scene: Scene, *, picture: tuple[int, int], hidden: Tensor | None = None
    ) -> Spectra:
        """Those before a camera."""
        light = compressed(scene)
        return cls(Transfers(imaging, light, picture), light, recorded(camera, scene), hidden=hidden)

    def through(self, optics: Transfers) -> Spectra:
        """The same light through others; its spectra are shared."""
        own = Spectra(optics, self.scene, self.weights, hidden=self.hidden, hues=self.hues)
        own._layered = self._layered
        return own

    def compare(self, settings: Mapping[str, Any], recorded: Tensor, *, cut: Tensor) -> bool:
        """Take what pixels truly record with some settings, the energy of each row (B,), for what errors are relative
        to, where that is less than what spectra say: of a light that falls on pixels which see little of its colour,
        or of light beyond borders that are not mirrors. cut: rows of which the full well cuts light off, so that what
        is left of it is known with these settings alone.

        Returns: whether spectra tell of this scene: not where much more is recorded, of light that goes on beyond a
        replicated border.
        """
        said = self._whole(settings, Way.PSFS)
        if self.imaging.border == "replicate" and bool((recorded > _GOES_ON * said).any()):
            return False
        if bool(cut.any()):
            every = {**settings, "bands": None}
            said = torch.where(cut, self._whole(every, self._way_of_colours(1, every)[0]), said)
        self._unlike = (said / recorded.to(said).clamp(min=1e-300)).clamp(min=1)
        return True

    @property
    def unlike(self) -> float:
        """What spectra said of the light of a row over what was recorded of it, in energy, at most: see `compare`."""
        return float(self._unlike.max())

    def dimmed(self, settings: Mapping[str, Any]) -> list[float]:
        """How much less light there is of each row with some settings than without blur: RMS over RMS."""
        sharp, seen = (self._whole(own, Way.LINES) for own in ({**settings, "blur": False}, settings))
        found: list[float] = (sharp / (seen * self._framed).clamp(min=1e-300)).sqrt().clamp(min=1).tolist()
        return found

    def frame(self, settings: Mapping[str, Any]) -> bool:
        """Know what light of each row falls into the picture with some settings, of what there is where borders are
        mirrors, or of all that there is where it is dark beyond them: by PSFs that are products of line spreads.

        Returns: whether spectra tell of this scene, as `compare`.
        """
        border, imaging = self.imaging.border, self.optics.stage(settings)
        for rows, scene in self.groups:
            light = self._light[rows]
            vergences, shares = self._cutting(scene, settings.get("layers")).layers_of(scene, light)
            step = max(1, min(light.shape[-2:]) // _FRAMED)
            planes = functional.avg_pool2d(light if shares is None else light * shares, step)
            transfer = self.optics.of(imaging, vergences, scene.wavelengths, Way.LINES)[0].mean(1)
            inside, everywhere = blurred(planes, transfer, self.frequencies * step, border)
            if border != "zero":
                everywhere, _ = blurred(planes, transfer, self.frequencies * step, "reflect")
            framed = (inside / everywhere.clamp(min=1e-300)).clamp(min=1e-3)
            self._framed[rows] = 1 / (1 + _OUTSIDE * (1 / framed - 1)).clamp(min=1e-3)
        self._unlike = (self._unlike / self._framed).clamp(min=1)
        return border != "replicate" or float(self._framed.max()) < _GOES_ON

    def _whole(self, settings: Mapping[str, Any], way: Way) -> Tensor:
        """The energy of each row with some settings, (B,)."""
        found = torch.zeros(len(self.scene.coefficients), dtype=torch.float64)
        for index, (rows, _) in enumerate(self.groups):
            found[rows] = self._all_of_it(index, settings, way)
        return found

    def _all_of_it(self, index: int, settings: Mapping[str, Any], way: Way) -> Tensor:
        """The energy of each row of a group with some settings; kept, because choices are compared with the same."""
        key = index, way, *sorted(settings.items())
        if key not in self._energies_known:
            layered = self._of(index, settings.get("layers"))
            self._energies_known[key] = self._energy(self._once(index, layered, settings, settings, way), layered)
        return self._energies_known[key]

    @functools.cached_property
    def grey(self) -> Spectra:
        """The same in light of a few wavelengths, as much of each as is recorded around it: depth, and what hides what,
        have no colour, but lenses have. Its hues are those of what is recorded: of colours that are as bright as each
        other the sum shows nothing.
        """
        stage, few = self.optics.stage({"bands": FEW_BANDS}), self.optics.few
        shares = stage.shares(self.wavelengths)
        much = self._recorded_bands if shares is None else self._recorded_bands @ shares.to(self._recorded_bands)
        light, spectrum = self._light, (much / much.max().clamp(min=1e-30)).clamp(min=UNSEEN)[None].to(self._light)
        grey = replace(self.scene, coefficients=light, spectra=spectrum, wavelengths=few, illuminant=spectrum[0])
        return Spectra(self.optics, grey, None, hues=hues(self.scene, self.weights))

    @functools.cached_property
    def _coloured(self) -> Tensor:
        """Times the contrast of grey light, in energy, that there is in its hues, (B,), at least 1."""
        own = self._light if self.hues is None else self.hues
        return (contrast(own) / self.contrast.clamp(min=UNSEEN)).clamp(min=1)

    @functools.cached_property
    def contrast(self) -> Tensor:
        """What differs from its mean, of the energy of what is recorded in all bands, (B,)."""
        return contrast(self._light)

    @functools.cached_property
    def _light(self) -> Tensor:
        """What is recorded of each pixel in all bands, (B, 1, H, W)."""
        shares = self._recorded_spectra.sum(1).to(self.scene.coefficients)
        return torch.einsum("k,bkhw->bhw", shares, self.scene.coefficients)[:, None]

    @property
    def _recorded_spectra(self) -> Tensor:
        """What is recorded of each plane in each band, (K, L)."""
        scene = self.scene
        spectra = torch.eye(len(scene.wavelengths)) if scene.spectra is None else scene.spectra
        return spectra if self.weights is None else spectra * self.weights.abs().sum(0).to(spectra)

    @functools.cached_property
    def _recorded_bands(self) -> Tensor:
        """What is recorded of the scene in each band, (L,)."""
        light = self._bands.clamp(min=0)
        return light if self.weights is None else light * self.weights.abs().sum(0).to(light)

    @functools.cached_property
    def _bands(self) -> Tensor:
        """The scene's light in each band, (L,)."""
        light = self.scene.coefficients.detach().sum((0, 2, 3)).double().cpu()
        return light if self.scene.spectra is None else light @ self.scene.spectra.double().cpu()

    @functools.cached_property
    def _masks(self) -> Spectra:
        """Even light everywhere, in the same layers: what hides what is counted in it."""
        even = torch.ones(1, len(self.scene.wavelengths)).to(self._light)
        ones = replace(self.scene, coefficients=torch.ones_like(self._light), spectra=even, illuminant=even[0])
        return Spectra(self.optics, ones, self.weights)

    def tabled(self, settings: Mapping[str, Any]) -> bool:
        """Whether transfer functions of all wavelengths are known at once."""
        return all(self.optics.table(*asked) or self.optics.lines(*asked) for asked in self._at_once(settings))

    def by_lines(self, settings: Mapping[str, Any]) -> bool:
        """Whether those that are known at once are line spreads."""
        asked = [*self._at_once(settings)]
        return all(self.optics.table(*one) is None and self.optics.lines(*one) is not None for one in asked)

    def _at_once(self, settings: Mapping[str, Any]) -> Iterator[tuple[Imaging, Tensor, Tensor]]:
        imaging = self.optics.stage(settings)
        for index in range(len(self.groups)):
            yield imaging, self._of(index, settings.get("layers")).vergences, self.optics.few

    def narrow(self, settings: Mapping[str, Any], side: int) -> tuple[int, int] | None:
        """The middle of wide windows, so many pixels at most, where that holds most of the light with some settings, as
        far as it is known without PSFs.
        """
        optics, found = self.optics, (0, 0)
        imaging = optics.stage(settings)
        wavelengths = imaging.psf_wavelengths(self.wavelengths, deep=optics.deep)
        for index in range(len(self.groups)):
            vergences = self._of(index, settings.get("layers")).vergences
            window = optics.window(imaging, vergences)
            if max(window) <= 2 * side:  # less wide ones take no longer than it takes to know
                return None
            found = min(side, window[0]), min(side, window[1])
            own = imaging.changed(psf_shape=found)
            known = optics.table(own, vergences, wavelengths) or optics.lines(own, vergences, wavelengths)
            if known is None:
                return None
            light = known(self.frequencies[:1], found, wavelengths).real.prod(2)  # what either side lets pass
            if float(light.min()) < _MOST:
                return None
        return found

    def energies(
        self, changes: Mapping[str, Any], against: Mapping[str, Any], care: Care = Care.FULL
    ) -> tuple[Tensor, Tensor]:
        """For each row: the energy of the difference that changes make, and that of what it is against, (B,); of
        different layers, where that has the finer ones.
        """
        off, all_of_it = self._energies(changes, against, care)
        return off * self._unlike, all_of_it

    def _energies(self, changes: Mapping[str, Any], against: Mapping[str, Any], care: Care) -> tuple[Tensor, Tensor]:
        if care is not Care.FULL and not differ(changes, against, WINDOW):
            changes, against = {**changes, "bands": 1}, {**against, "bands": 1}
        if changes.get("layers") == against.get("layers"):
            colours, replaced = not differ(changes, against, LINEAR - COLOURS), self._replaced
            if colours and self._hides:
                replaced = torch.where(self.few_lights, _HIDDEN_LIGHTS, replaced)
            elif differ(changes, against, WINDOW):
                through = self.few_lights & (replaced == _SEEN_THROUGH)
                replaced = torch.where(through, _SEEN_THROUGH_LIGHTS, replaced)
            off, all_of_it = self._linear(changes, against, care, replaced)
            if self.hidden is None or not self._hides:
                return off, all_of_it
            if colours:
                off = off * (1 + _COLOURED * _drowned(self.hidden))
            return off + self._by_masks(changes, against, care, self.hidden) * all_of_it, all_of_it
        every, grey = {"bands": None}, self.grey
        off, all_of_it = grey._linear({**changes, **every}, {**against, **every}, Care.FULL, grey._replaced)
        laid_over = self._hides and changes.get("layers") != 1  # one plane hides nothing
        return off * torch.where(self.few_lights & laid_over, _OVER_LIGHTS**2, 1.0), all_of_it

    def _by_masks(self, changes: Mapping[str, Any], against: Mapping[str, Any], care: Care, hidden: Tensor) -> Tensor:
        """The energy by which what is hidden is off as masks are, of all that there is, (B,): `_EDGES` of it, more
        where much is hidden, and all of it where light of some layers does not fall into the window (`_LOST`): there
        masks have colours, and errors are relative to what they leave of the light behind.
        """
        lost, colours = self.optics.lost_between_ends, not differ(changes, against, LINEAR - COLOURS)
        if colours and lost < _LOST:
            return self._of_other_colours(changes, against, care, hidden)
        of_masks = {**changes, **WHOLE}, {**against, **WHOLE}
        off, even = self._masks._linear(*of_masks, care, torch.full_like(hidden, _HIDDEN))
        share = torch.full_like(hidden, lost)
        if not colours:
            share = (_EDGES + _drowned(hidden) + lost).clamp(max=1)
        said = share * hidden * off / even.clamp(min=1e-300)
        return said if lost < _LOST else said / (1 - self._veiled) ** 2

    def _of_other_colours(
        self, changes: Mapping[str, Any], against: Mapping[str, Any], care: Care, hidden: Tensor
    ) -> Tensor:
        """The energy by which a choice of wavelengths is off at edges of depth, of all that there is, (B,): masks are
        blurred as white light is, and hide light of a few bands that is blurred otherwise.
        """
        if self._unlike_white is None:
            return torch.zeros_like(hidden)
        off, _ = self._unlike_white._linear({**changes, **WHOLE}, {**against, **WHOLE}, care, torch.ones_like(hidden))
        even = self._light_by_channel.sum(1).square().sum() * math.prod(self.scene.shape[1:])
        return hidden * off / even.clamp(min=1e-300)

    @functools.cached_property
    def _unlike_white(self) -> Spectra | None:
        """Masks in what is recorded of each band less that of white light, where these are unlike."""
        if not self.of_lines or not self._white_masks:
            return None
        return Spectra(self.optics, self._masks.scene, self._less_white)

    @property
    def _white_masks(self) -> bool:
        """Whether masks are blurred as white light is, in channels of several bands."""
        return self.weights is not None and self.imaging.accuracy.coverage == "channel"

    @property
    def of_lines(self) -> bool:
        """Whether light is mostly of other bands than white light, as it is recorded."""
        return float(self._less_white.abs().sum()) > 2 * _UNLIKE_WHITE * float(self._light_by_channel.sum())

    @functools.cached_property
    def _less_white(self) -> Tensor:
        """What is recorded in each band less what would be of white light that is as bright, (R, L)."""
        seen, white = self._light_by_channel, self._white
        return seen - white * (seen.sum(1, keepdim=True) / white.sum(1, keepdim=True).clamp(min=1e-300))

    @property
    def _white(self) -> Tensor:
        """What each sum of bands records of white light in each band, (R, L)."""
        weights = torch.ones(1, len(self.wavelengths)) if self.weights is None else self.weights
        return weights.double().cpu().abs()

    @property
    def _light_by_channel(self) -> Tensor:
        """The same of the scene's light."""
        return self._white * self._bands.clamp(min=0)

    def behind_edges(self, changes: Mapping[str, Any], against: Mapping[str, Any]) -> float:
        """How much more goes on behind what is nearer, of the light that does, RMS over the channels.

        There light is divided by what its mask leaves, and both are tails of diffraction, as bright as their wavelength
        is long. Masks are white in each channel; light of a few bands is not, and other PSFs stand for either.
        """
        if not self._white_masks:
            return 0.0
        white, light = self._white, self._light_by_channel
        power = light.sum(1).square()

        def tails(settings: Mapping[str, Any]) -> Tensor:
            stage = self.optics.stage(settings)
            nodes = stage.psf_wavelengths(self.wavelengths, deep=self.optics.deep).double().cpu()
            shares = stage.shares(self.wavelengths, deep=self.optics.deep)
            own = nodes if shares is None else shares.to(nodes) @ nodes
            ours, theirs = (of @ own / of.sum(1).clamp(min=1e-300) for of in (light, white))
            return ours / theirs.clamp(min=1e-300)

        off = (tails(changes) - tails(against)).square() * power
        return math.sqrt(float(off.sum() / power.sum().clamp(min=1e-300)))

    def hiding(self, changes: Mapping[str, Any], against: Mapping[str, Any], rows: list[int]) -> tuple[Tensor, Tensor]:
        """The same of some rows, and of what hides what: tried out."""
        grey = self.grey.scene.samples(rows)
        stage = self.grey._cutting(grey, against.get("layers"))
        changed = (stage.changed(**{**own, "bands": None}) for own in (changes, against))
        ours, theirs = (imaging(grey).double().cpu() for imaging in changed)
        off = (ours - theirs).square().sum((1, 2, 3)) * self.grey._coloured[rows]
        return off, theirs.square().sum((1, 2, 3))

    def _linear(
        self, changes: Mapping[str, Any], against: Mapping[str, Any], care: Care, replaced: Tensor
    ) -> tuple[Tensor, Tensor]:
        """As `energies`; replaced: times the error without occlusion that there is with it, (B,)."""
        found = torch.zeros(2, len(self.scene.coefficients), dtype=torch.float64)
        way, more = self._way(changes, against, care)
        # layers lie between others, and windows cut the same off all of them: 1.0 to 1.2 times the truth, measured
        corners = 1.0 if changes.get("layers") != against.get("layers") else self.optics.corners
        colours = not differ(changes, against, LINEAR - COLOURS)
        factor = torch.tensor(corners, dtype=torch.float64)
        if colours:
            usual = torch.tensor(self.optics.corners_of_colours, dtype=torch.float64)
            factor = torch.where(self.few_lights, factor.maximum(usual), usual)
        factor = factor * more
        if differ(changes, against, {"interpolate_bands"}):
            of_lights = _BETWEEN_LIGHTS if self.optics.has_pixel_phase else _BETWEEN_PSFS
            factor = factor * torch.where(self.few_lights, of_lights, _BETWEEN_PSFS).double()
        if PARAXIAL.items() <= changes.items() and PARAXIAL.items() <= against.items():
            factor = factor * self.optics.by_paraxial
        for index, (rows, _) in enumerate(self.groups):
            layered = self._of(index, against.get("layers"))
            # that with the larger window first
            theirs, ours = (self._once(index, layered, own, against, way) for own in (against, changes))
            found[0, rows], found[1, rows] = self._energy(ours - theirs, layered), self._all_of_it(index, against, way)
            if way is Way.LINES and differ(changes, against, {"propagator"}):
                least = self.optics.untold(self.optics.stage(against), layered.vergences, self.wavelengths)
                found[0, rows] = found[0, rows].maximum(least**2 * found[1, rows])
            if len(layered.vergences) > 1:
                found[0, rows] *= replaced[rows] ** 2
        return found[0] * factor**2 * self._alone, found[1]

    def _way_of_colours(self, psfs: int | None, against: Mapping[str, Any]) -> tuple[Way, float]:
        """As `_way`, of so many PSFs for all wavelengths."""
        if not self.tabled(against):
            return Way.LINES, 1.0
        return self.optics.between(psfs, lines=self.by_lines(against))

    def _way(self, changes: Mapping[str, Any], against: Mapping[str, Any], care: Care) -> tuple[Way, float]:
        """How transfer functions are found that tell of changes, and times the error that they tell."""
        by_psfs = differ(changes, against, WITH_PSFS if care is Care.FULL else WITH_PSFS - TOLD_BY_LINES)
        if by_psfs or (differ(changes, against, COLOURS | {"layers"}) and self.optics.missed):
            return Way.PSFS, 1.0
        if care is Care.AT_FIRST:
            return Way.WHOLE_LINES, 1.0
        if differ(changes, against, COLOURS):
            return self._way_of_colours(changes.get("bands"), against)
        return Way.LINES, 1.0

    @functools.cached_property
    def _veiled(self) -> Tensor:
        """Of what lies farther, about how much something nearer covers everywhere that is blurred far wider, (B,)."""
        ends, light = self.optics.ends, self.optics.passed.mean(1)
        vergence = 1 / torch.as_tensor(self.scene.depth, dtype=torch.float64).cpu()
        near = (vergence > ends.mean()).double().flatten(1).mean(1) if vergence.ndim > 1 else torch.zeros(1)
        return (near * float(light[-1] < light[0])).clamp(max=_MOST_VEILED).expand(len(self.scene.coefficients))

    @functools.cached_property
    def _alone(self) -> Tensor:
        """What the energy of a difference may be, of that in the mean over directions, (B,): more by 1 over the number
        of lights, if few have most of the energy. Their spectrum is even: it shows the corners of a window.
        """
        return 1 + 1 / lights(self._light)

    @functools.cached_property
    def few_lights(self) -> Tensor:
        """Whether a few pixels, or patches, have most of the energy of a row, (B,)."""
        return few_lights(self._light)

    @functools.cached_property
    def _replaced(self) -> Tensor:
        """Times the error without occlusion that there is with it, (B,): more of a few lights or patches of light, and
        where something near is seen through.
        """
        if not self._hides:
            return torch.ones_like(self._unlike)
        defocus = self.optics.defocus
        found = torch.where(self.few_lights, _HIDDEN_LIGHTS, _HIDDEN).double()
        depth = torch.as_tensor(self.scene.depth, dtype=torch.float64).cpu()
        ends = (1 / (depth.flatten(1) if depth.ndim > 1 else depth.view(-1, 1))).aminmax(dim=1)
        far, near = (defocus.radius(end) - defocus.floor for end in ends)
        wide = (near > _WIDE * min(self.optics.picture)) & (far < near / 2)
        return torch.where(wide, _SEEN_THROUGH, found)

    def _energy(self, mixed: Tensor, layered: _Layered) -> Tensor:
        """Of transfer functions (R, K Z, 2, F), recorded, (B,)."""
        at_once = mixed.permute(2, 3, 0, 1)  # (2, F, R, K Z)
        parts = torch.cat([at_once.real, at_once.imag], dim=2) if mixed.is_complex() else at_once
        if isinstance(layered.light, Tensor):
            return ((parts @ layered.light) * parts).sum((1, 2, 3, 4)).clamp(min=0)
        return torch.stack([torch.stack([hue.energy(parts) for hue in row]).sum() for row in layered.light])

    def _of(self, index: int, layers: Any) -> _Layered:
        key = index, str(layers)
        if key not in self._layered:
            scene = self.groups[index][1]
            imaging = self._cutting(scene, layers)
            planes = imaging.working(scene)
            vergences, shares = imaging.layers_of(scene, planes)
            if self.hues is not None:
                planes = self.hues[self.groups[index][0]].to(planes)
            in_layers = _in_layers(planes, shares, apart=self.hues is not None)
            look = functools.partial(
                in_rings, frequencies=self.frequencies, dark=imaging.border == "zero", turned=self.optics.turned
            )
            self._layered[key] = _Layered(vergences, _crossed(in_layers, look))
        return self._layered[key]

    def _cutting(self, scene: Scene, layers: Any) -> Imaging:
        """The stage with so many layers, or as many as light of all wavelengths asks for: a few ask for fewer, and a
        part of a scene for others than the whole.
        """
        imaging = self.imaging if layers is None else self.imaging.changed(layers=layers)
        own = imaging.accuracy.layers is not None or len(scene.wavelengths) == len(self.wavelengths)
        if not is_deep(scene) or (own and self.optics.cut(imaging) is None):
            return imaging
        return imaging.changed(layers=tuple((1 / self._cut(scene, imaging)).tolist()))

    def _cut(self, scene: Scene, imaging: Imaging) -> Tensor:
        """Vergences of the layers that a stage cuts a scene into, or the whole of which it is a part, in light of all
        wavelengths, (Z,).
        """
        found = self.optics.cut(imaging)
        if found is None:
            depth = torch.as_tensor(scene.depth, dtype=torch.float64)
            found = imaging.vergences(scene, depth, wavelengths=self.wavelengths).cpu()
        return found

    def _once(
        self, index: int, layered: _Layered, changes: Mapping[str, Any], against: Mapping[str, Any], way: Way
    ) -> Tensor:
        key = index, way, str(against.get("layers")), *sorted(changes.items())
        if key not in self._known:
            between = None
            if changes.get("layers") != against.get("layers"):
                between = self._between(self.groups[index][1], layered.vergences, self.optics.stage(changes))
            self._known[key] = self._mixed(layered, changes, between, way)
        return self._known[key]

    def _between(self, scene: Scene, vergences: Tensor, imaging: Imaging) -> tuple[Tensor, Tensor]:
        """Vergences (Y,) of the layers of a stage, and what each of others, (Z,), takes from these, (Z, Y)."""
        own = self._cut(scene, imaging)
        if len(own) == 1:
            return own, torch.ones(len(vergences), 1, dtype=torch.float64)
        shares = layer_shares(vergences.cpu()[None, None, None], own, interpolate=imaging.accuracy.interpolate)[0, :, 0]
        present = shares.amax(1) > 0
        return own[present], shares[present].T

    def _mixed(
        self, layered: _Layered, changes: Mapping[str, Any], between: tuple[Tensor, Tensor] | None, way: Way
    ) -> Tensor:
        """Of each sum of bands for each plane in each layer, (R, K Z, 2, F).

        between: what `_between` says of the layers of these changes, if they are others.
        """
        imaging, scene = self.optics.stage(changes), self.scene
        vergences = layered.vergences if between is None else between[0]
        if between is not None and _among(vergences, every := layered.vergences.cpu()):
            vergences, between = layered.vergences, (vergences, between[1] @ cubic_weights(every, vergences))
        transfer, shares = self.optics.of(imaging, vergences, scene.wavelengths, way)
        if between is not None:
            transfer = torch.einsum("zy,ygof->zgof", between[1].to(transfer.dtype), transfer)
        spectra = None if scene.spectra is None else scene.spectra.double().cpu()
        shaped = torch.empty(1, transfer.shape[1], 1, 1, dtype=torch.float64)
        mixing = Renderer(shaped, spectra=spectra, weights=self.weights, picture=(1, 1), shares=shares).mixing()
        mixed = mixing.flatten(0, 1).to(transfer.dtype) @ transfer.flatten(2).transpose(0, 1).flatten(1)
        mixed = mixed.view(len(mixing), -1, len(transfer), 2, len(self.frequencies))
        return mixed.flatten(1, 2)

    @property
    def _hides(self) -> bool:
        """Whether one part of the scene may hide another."""
        return self.imaging.accuracy.occlusion and is_deep(self.scene)


def _in_layers(planes: Tensor, shares: Tensor | None, *, apart: bool) -> Iterator[Iterable[Tensor]]:
    """Of each row (B, J, H, W) its light in layers (B, Z, H, W), (J Z, H, W) or each hue apart, one after the other."""
    for row, light in enumerate(planes):
        own = None if shares is None else shares[row]
        if apart:
            yield (hue[None] if own is None else hue * own for hue in light)
        else:
            yield [light if own is None else (light[:, None] * own).flatten(0, 1)]


def _crossed(rows: Iterator[Iterable[Tensor]], look: Callable[[Tensor], InRings]) -> Tensor | list[list[InRings]]:
    """Of the planes (K, H, W) of each row's hues, as `_Layered` has them."""
    seen = ([*map(look, row)] for row in rows)
    first = next(seen)
    if first[0].many_planes:
        return [first, *seen]
    return torch.stack([torch.stack([hue.crossed() for hue in row]).sum(0) for row in itertools.chain([first], seen)])


def _drowned(hidden: Tensor) -> Tensor:
    """How much more is hidden than masks say at edges alone, 0 to 1, (B,)."""
    return (hidden - _DROWNED).clamp(0, 1)


def differ(changes: Mapping[str, Any], against: Mapping[str, Any], names: set[str]) -> bool:
    """Whether two settings have other values of some of these names."""
    return any(changes.get(name) != against.get(name) for name in names)


def _among(vergences: Tensor, others: Tensor) -> bool:
    """Whether layers are some of others, or few enough to lie between these, so that they need nothing of their own."""
    if _BETWEEN_LAYERS * len(vergences) <= len(others):
        return True
    apart = (vergences[:, None] - others).abs().amin(1)
    return bool((apart <= _SAME_LAYER * (others.max() - others.min())).all())
