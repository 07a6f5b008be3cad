"""What a choice changes in the noiseless raw: from spectra, or tried out on the scene, or on a few crops of it.

By spectra where the raw is linear in the light, see `spectra`: then no picture is rendered, and the choices of a plan
add up. Else a choice is tried out: inside the camera's own borders, mosaic, layers and full well. It is cheap because
it is tried beside others that are cheap, few wavelengths and few layers of depth, and on `samples` of the scenes.

What trials of one choice tell little of another's ends with a last trial, of the whole plan against the reference, on
all that was planned for, or on the worst `WITNESSED` pixels of it.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from kcam.camera import Camera
from kcam.context import Context
from kcam.effects import Skippable
from kcam.optics import CompoundLens, Imaging, Lens
from kcam.optics.field import ALLOWED
from kcam.optics.rendering.place import Place
from kcam.optics.source import Defocus
from kcam.planner.light import linear
from kcam.planner.over_field import TOLD, OverField
from kcam.planner.plan import ENDS, Shortcuts, noiseless_raw, relative_rms, shortened, with_imaging
from kcam.planner.samples import Sample, samples_of
from kcam.planner.spectra import LINEAR, Care, Spectra
from kcam.planner.survey import BEYOND, TILE, Survey, stops, survey
from kcam.scene import Scene
from kcam.sensor import ADC, ColourFilter, Mosaic, Transmission
from kcam.sensor.random_stage import RandomStage

LARGEST = 320**2  # pixels that are tried whole, of a scene and of the items of a batch
CROP = 160  # side of the crops of larger scenes, beside what blur reaches [pixels]
WITNESSED = 2**20  # pixels of the last trial
UNTOLD = 2 * ALLOWED  # error over the field, below which it is not told: near what the reference may be off by
NOTHING: Shortcuts = {}
CUT = 1.01  # RMS of light over that of what the full well leaves of it, from which on that matters
LOOKED = 129  # side of the PSFs with which the light is looked at, where these hold most of it: wide ones take long
UNLIKE = 1.1  # of sharp light, in energy, up to which what pixels see of colours is as in blurred light
HARDLY = 3e-3  # RMS of light that may be hidden, of what is recorded, that is taken for what it changes at most


@dataclass(frozen=True)
class Answer:
    """A noiseless raw, and the gradient of each parameter where gradients are wanted."""

    raw: Tensor
    gradients: tuple[Tensor, ...]


class Evaluator:
    """A camera's noiseless raw of some samples under changes of its Imaging, each computed once.

    Gradients are wanted where autograd is on and a parameter of the raw's stages requires them: then an error is the
    largest of the raw's and of each parameter's gradient. They are those of the mean square between the raw and the
    raw of a camera that does not blur, a picture that a camera may be trained for.
    """

    def __init__(self, camera: Camera, scenes: Sequence[Scene]) -> None:
        self.camera, raw = camera, noiseless_raw(camera)
        known = (stage.knowing(scenes[0].wavelengths) if isinstance(stage, Imaging) else stage for stage in raw)
        self.raw_camera = Camera(*known, context=raw.context)  # whose PSFs are computed once
        stages: list[Any] = list(self.raw_camera)
        self.index = next((i for i, stage in enumerate(stages) if isinstance(stage, Imaging)), None)
        self.imaging: Imaging | None = None if self.index is None else stages[self.index]
        self.parameters = [p for p in self.raw_camera.parameters() if p.requires_grad]
        self.gradients = torch.is_grad_enabled() and bool(self.parameters)
        self.defocus = Defocus() if self.imaging is None else self.imaging.defocus(scenes[0].wavelengths)
        full = [scene for scene in scenes if scene.coefficients.numel()]
        self.varies = self.imaging is not None and self.imaging.varies
        self.whole = any(getattr(stage, "only_whole", False) for stage in stages)  # a map of the picture is of no crop
        self._answers: dict[tuple[Any, ...], list[Answer]] = {}
        self.scenes = full
        self.signals: list[dict[int, tuple[Tensor, Context]]] = []
        self.lost: dict[int, float] = {}  # see `_cut_off`
        self._looked: Mapping[str, Any] = {}
        self.dimmed: list[float] = []  # of each signal, by blur, where it was looked at without: RMS over RMS
        self.spectra: list[Spectra] | None = None
        self._hiding: dict[Any, float] = {}
        self._laid_out: dict[tuple[Any, ...], tuple[Tensor, Tensor, list[Place]]] = {}

    def laid_out(self, imaging: Imaging, scene: Scene) -> tuple[Tensor, Tensor, list[Place]]:
        """Planes of one of the scenes, vergences of its layers in a stage changed from this one's, and where each is:
        looked at once, because that takes as long as much else of a plan.
        """
        key = id(scene), imaging.layers, imaging.interpolate, imaging.blur, imaging.precision
        if key not in self._laid_out:
            self._laid_out[key] = imaging.working(scene), *imaging.filled(scene)
        return self._laid_out[key]

    @functools.cached_property
    def over_field(self) -> list[OverField] | None:
        """What spectra tell of each sample, where optics vary over the picture as those of kcam do."""
        imaging = self.imaging
        if imaging is None or not isinstance(imaging.lens, (Lens, CompoundLens)) or not self.varies:
            return None
        if self.gradients or not linear(self.raw_camera):
            return None
        return [OverField(self.raw_camera, imaging, own, hidden=self._hideable(own)) for own in self.samples]

    @functools.cached_property
    def surveys(self) -> list[list[Survey]]:
        """Of each scene, what was seen of its items."""
        return [survey(scene, self.raw_camera, self.defocus) for scene in self.scenes]

    @functools.cached_property
    def samples(self) -> list[Sample]:
        """What choices are tried on."""
        # over the field a whole picture takes fewer PSFs than its crops: places mirror each other
        if self.whole:
            return self.witnesses
        return samples_of(self.scenes, self.surveys, pixels=WITNESSED if self.varies else LARGEST, side=CROP)

    def samples_have(self, distances: Tensor) -> bool:
        """Whether there is something at each of so many distances in what choices are tried on."""
        found = torch.cat([torch.as_tensor(sample.scene.depth).flatten() for sample in self.samples])
        return bool(torch.isin(distances, found).all())

    @functools.cached_property
    def witnesses(self) -> list[Sample]:
        """What a finished plan is tried on."""
        return samples_of(self.scenes, self.surveys, pixels=2**62 if self.whole else WITNESSED)

    def look(self, settings: Mapping[str, Any]) -> None:
        """See what the stages of the sensor are given, with about these optics or without blur, and whether spectra
        tell what choices cost: where the raw is linear in the light, but for what the full well cuts off.
        """
        self._looked = settings
        few = {**settings, "bands": 1, "occlusion": False}  # it moves little of the light, and takes half of the time
        if "layers" in few and not any(bool(one.potential[BEYOND].any()) for one in self.items):
            few["layers"] = 1
        if self.imaging is not None and not self.gradients and not self.varies and linear(self.raw_camera):
            self.spectra = [
                Spectra.of(
                    self.raw_camera, self.imaging, sample.scene, picture=sample.picture, hidden=self._hideable(sample)
                )
                for sample in self.samples
            ]
            # no grid of the pupil is coarse in spectra, and what these settings ask for others will ask for too
            if self._sharply(self.imaging, self.spectra, {k: v for k, v in settings.items() if k != "kappa"}):
                return
            narrow = [window for one in self.spectra if (window := one.narrow(few, LOOKED))]
            if narrow and len(narrow) == len(self.spectra):
                few |= {"psf_shape": max(narrow), "renormalise": True}
        if self.over_field and self.imaging is not None and self._sharply(self.imaging, self.over_field, settings):
            return
        self.signals = self._signals(few | {"precision": "float32"})  # which holds what is bright
        self.lost = self._cut_off()
        if max(self.lost.values(), default=1.0) > CUT:
            self.over_field = None  # what is cut off differs from place to place
        if self._told and not self._compare({name: value for name, value in few.items() if name != "occlusion"}):
            self.spectra = None

    def _sharply(self, imaging: Imaging, told: Sequence[Spectra | OverField], settings: Mapping[str, Any]) -> bool:
        """See the same without blur, where that tells as much: of light of which nothing is cut off, as of a few lights
        that stand out, and not more where pixels see little of its colour.
        """
        known = isinstance(imaging.lens, Lens) or self.varies  # whose PSFs brighten nothing
        if not known or self.few_lights:
            return False
        self.signals = self._signals(sharp := {**settings, "blur": False})
        self.lost = self._cut_off()
        if max(self.lost.values()) > 1:
            return False
        self._compare(sharp)
        if max(spectra.unlike for spectra in told) > UNLIKE:
            return False
        if imaging.border != "reflect" and not all(one.frame(settings) for one in told):
            return False
        self.dimmed = [row for spectra in told for row in spectra.dimmed(settings)]
        return True

    def _compare(self, settings: Mapping[str, Any]) -> bool:
        """What spectra say of the light with what was seen of it, where nothing but colours lies between; whether they
        tell of it at all.
        """
        between: tuple[type, ...] = (Imaging, ColourFilter, Mosaic)
        if any(isinstance(stage, ColourFilter) for stage in self.raw_camera):  # which is seen behind the glass
            between += (Transmission,)
        behind = 1 + max(index for index, stage in enumerate(self.raw_camera) if isinstance(stage, between))
        if not all(isinstance(stage, between) for stage in list(self.raw_camera)[:behind]):
            return True
        energies = torch.stack([given[behind][0].double().square().sum().cpu() for given in self.signals])
        rows = energies.split([len(sample.owners) for sample in self.samples])
        cut = ([self.lost[owner] > CUT for owner in sample.owners] for sample in self.samples)
        parts = zip(self._told, rows, cut, strict=True)
        return all(spectra.compare(settings, own, cut=torch.tensor(lost)) for spectra, own, lost in parts)

    def _hideable(self, sample: Sample) -> Tensor:
        """See `Spectra`."""
        items = (self.items[owner] for owner in sample.owners)
        return torch.tensor([one.hidden**2 / max(one.behind, 1e-3) for one in items], dtype=torch.float64)

    @property
    def _signals_by_owner(self) -> Iterator[tuple[int, dict[int, tuple[Tensor, Context]]]]:
        owners = (owner for sample in self.samples for owner in sample.owners)
        return zip(owners, self.signals, strict=True)

    def _cut_off(self) -> dict[int, float]:
        """RMS of the light of each whole over that of what the full well leaves of it."""
        energies: dict[int, list[float]] = {}
        for owner, given in self._signals_by_owner:
            clips = [index for index, stage in enumerate(self.camera) if stops(stage)]
            signal = given[min(clips)][0].detach() if clips and min(clips) in given else torch.ones(1)
            whole = energies.setdefault(owner, [0.0, 0.0])
            for index, light in enumerate((signal, signal.clamp(max=1))):
                whole[index] += float(light.square().sum(dtype=torch.float64))
        return {owner: math.sqrt(one / other) if other else 1.0 for owner, (one, other) in energies.items()}

    @property
    def items(self) -> list[Survey]:
        """Of every item of every scene, what was seen of it."""
        return [one for found in self.surveys for one in found]

    @property
    def certain(self) -> bool:
        """Whether what choices cost is known without trying all of them together."""
        return self.spectra is not None or self.over_field is not None

    def foretells(self, allowed: float) -> bool:
        """Whether what choices cost is known so well that no last trial is needed: over the field not of a few lights,
        nor near what the reference itself may be off by.
        """
        return self.certain and (self.over_field is None or (allowed >= UNTOLD and not self.few_lights))

    @property
    def _told(self) -> Sequence[Spectra | OverField]:
        """What tells of each sample without trials."""
        return self.spectra or self.over_field or ()

    @property
    def few_lights(self) -> bool:
        """Whether a few lights stand out in some item, where that is known."""
        return any(bool(spectra.few_lights.any()) for spectra in self._told)

    @property
    def of_lines(self) -> bool:
        """Whether the light of some scene is that of few bands, where that is known."""
        return any(spectra.of_lines for spectra in self._told)

    @property
    def left_out(self) -> float:
        """RMS of what the paraxial model leaves out of the phase of any scene [rad]."""
        return max((spectra.optics.left_out for spectra in self.spectra or ()), default=0.0)

    @property
    def missed(self) -> bool:
        """Whether hardly any light falls into the window of some scene: see `Transfers`."""
        return any(spectra.optics.missed for spectra in self.spectra or ())

    def tabled(self, settings: Mapping[str, Any]) -> bool:
        """Whether all wavelengths may be compared at no cost."""
        return self.spectra is not None and all(spectra.tabled(settings) for spectra in self.spectra)

    def by_lines(self, settings: Mapping[str, Any]) -> bool:
        """Whether line spreads tell roughly what a window costs."""
        return self.spectra is not None and all(spectra.by_lines(settings) for spectra in self.spectra)

    def error(self, changes: Mapping[str, Any], against: Mapping[str, Any], care: Care = Care.FULL) -> float:
        """Relative RMS of the raw (and gradients) of one setting against another's, the worst over the scenes.

        By spectra light beyond the full well counts too, so that they say at least as much.
        """
        told = LINEAR if self.over_field is None else TOLD
        if not self.certain or not (changes.keys() | against.keys()) <= told:
            tried = _error(self.samples, self.answers(changes), self.answers(against))
            if not (changes.get("blur") is False is against.get("blur") and self.certain):
                return tried
            rank = changes.get("rank")
            unseen = self._dispersion * self._left_out_by_rank(rank) if rank is not None else 0.0
            return self._dimming * max(self.lost.values(), default=1.0) * math.hypot(tried, unseen)
        if changes.get("occlusion") != against.get("occlusion"):
            return self.hiding(changes, against)
        found = [0.0]
        for sample, spectra in zip(self.samples, self._told, strict=True):
            found += self._relative(sample, torch.stack(spectra.energies(changes, against, care)))
        return max(found)

    def _left_out_by_rank(self, rank: int) -> float:
        """RMS of what so few spectra leave out of all bands, relative to what is recorded: pixels see less of it, as
        long as light of all bands is blurred alike.
        """
        found = [0.0]
        for sample, spectra in zip(self.samples, self._told, strict=True):
            bands = sample.scene.bands()
            off = (sample.low_rank(rank).bands() - bands).square().sum((2, 3)).double().cpu()
            weights = torch.eye(bands.shape[1]) if spectra.weights is None else spectra.weights
            seen = torch.einsum("rl,blhw->brhw", weights.to(bands), bands).square().sum((1, 2, 3)).double().cpu()
            for rows, factor in sample.of_owners():
                power = float((off[rows] @ weights.double().square().sum(0)).sum())
                found.append(factor * math.sqrt(power / max(float(seen[rows].sum()), 1e-300)))
        return max(found)

    @property
    def _seen_with(self) -> dict[str, Any]:
        """Of the settings with which the light was looked at, those that spectra tell."""
        told = LINEAR - {"kappa"} if self.over_field is None else TOLD
        return {name: value for name, value in self._looked.items() if name in told}

    @functools.cached_property
    def _dispersion(self) -> float:
        """How far apart PSFs of the wavelengths are, relative to the contrast of what is seen, at most 1: of all, but
        where that takes their PSFs.
        """
        told = dict(self._seen_with) if self.missed else {k: v for k, v in self._seen_with.items() if k != "bands"}
        found = [0.0]
        for spectra in self._told:
            off, all_of_it = spectra.energies({**told, "bands": 1}, told)
            found += (off / (all_of_it * spectra.contrast).clamp(min=1e-300)).sqrt().tolist()
        return min(1.0, max(found))

    @functools.cached_property
    def _dimming(self) -> float:
        """How many times as large an error of light without blur may be beside what blur leaves of it: of a few lights
        whose error is in what lies around them. Trials that are tried together at last need not know.
        """
        if self.dimmed:
            return max(self.dimmed)
        return max((row for spectra in self._told for row in spectra.dimmed(self._seen_with)), default=1.0)

    def error_of(self, off: float) -> float:
        """The error of transfer functions that are off by so much of all light at most, at any frequency."""
        unlike = max((spectra.unlike for spectra in self._told), default=1.0)
        return off * self._dimming * math.sqrt(unlike) * max(self.lost.values(), default=1.0)

    @functools.cached_property
    def hidden(self) -> list[float]:
        """Of every item, RMS of the light that may be hidden, of what is recorded: all of it, of a few lights at
        several distances, for masks of layers may be as steep as these are.
        """
        found = [one.hidden for one in self.items]
        for sample, spectra in zip(self.samples, self._told, strict=False):
            for owner, few in zip(sample.owners, spectra.few_lights.tolist(), strict=True):
                if few and spectra.optics.deep:
                    found[owner] = max(found[owner], 1.0)
        return found

    def behind_edges(self, changes: Mapping[str, Any], against: Mapping[str, Any]) -> float:
        """Of light that goes on behind what is nearer, how much more that is: see `Spectra`."""
        return max((one.behind_edges(changes, against) for one in self._told if one.optics.deep), default=0.0)

    def hiding(self, changes: Mapping[str, Any], against: Mapping[str, Any]) -> float:
        """The error of what does not hide what it should, or otherwise, tried out on the scenes with most light that
        may be hidden; at most that light where there is hardly any. Kept, because ladders ask again.
        """
        key = *sorted(changes.items()), None, *sorted(against.items())
        if key not in self._hiding:
            self._hiding[key] = self._tried_hiding(changes, against)
        return self._hiding[key]

    def _tried_hiding(self, changes: Mapping[str, Any], against: Mapping[str, Any]) -> float:
        hidden = self.hidden
        found, tried, pixels = [min(light, HARDLY) for light in hidden], set(), 0
        for owner in sorted({*self.lost}, key=hidden.__getitem__, reverse=True):
            if hidden[owner] >= HARDLY and pixels < LARGEST:
                tried.add(owner)
                pixels += self.items[owner].recorded.numel() * TILE**2
        for sample, spectra in zip(self.samples, self._told, strict=True):
            rows = [row for row, owner in enumerate(sample.owners) if owner in tried]
            if rows:
                energies = torch.zeros(2, len(sample.owners), dtype=torch.float64)
                energies[:, rows] = torch.stack(spectra.hiding(changes, against, rows))
                found += self._relative(sample, energies)
        return max(found)

    def _relative(self, sample: Sample, energies: Tensor) -> Iterator[float]:
        """The error of each whole, from those of its rows and of what they are relative to, (2, B)."""
        for rows, factor in sample.of_owners():
            off, all_of_it = energies[:, rows].sum(1).tolist()
            yield factor * self.lost[sample.owners[rows[0]]] * math.sqrt(off / all_of_it) if all_of_it else 0.0

    def last(self, changes: Mapping[str, Any], shortcuts: Shortcuts) -> float:
        """True error of a finished plan on all that it is for, or on the worst of it: the worst over the scenes."""
        ours = [self._answer(sample, changes, shortcuts) for sample in self.witnesses]
        return _error(self.witnesses, ours, self._references)

    @functools.cached_property
    def _always(self) -> dict[str, Any]:
        """Changes under which crops are tried: where optics vary the places are about those of the reference, found
        once on the whole scenes.
        """
        if self.imaging is None or not self.varies:
            return {}
        if self.over_field is not None:
            return {"spacing": min(told.apart for told in self.over_field)}
        colours: Any = self.camera.resolve().colour_filter
        return {"spacing": min(self.imaging.apart(scene, colour_filter=colours) for scene in self.scenes)}

    @property
    def apart(self) -> int:
        """Pixels between the places of the reference, of optics that vary."""
        return int(self._always["spacing"])

    @functools.cached_property
    def _references(self) -> list[Answer]:
        return [self._answer(sample, {}) for sample in self.witnesses]

    def answers(self, changes: Mapping[str, Any]) -> list[Answer]:
        """The raw of every sample under changes of the Imaging."""
        key = tuple(sorted(changes.items()))
        if key not in self._answers:
            self._answers[key] = [self._answer(sample, changes) for sample in self.samples]
        return self._answers[key]

    def _answer(self, sample: Sample, changes: Mapping[str, Any], shortcuts: Shortcuts = NOTHING) -> Answer:
        with torch.set_grad_enabled(self.gradients):
            raw = self._raw(sample, changes, shortcuts)
            if not self.gradients or not raw.requires_grad:
                return Answer(raw.detach(), tuple(torch.zeros_like(p) for p in self.parameters if self.gradients))
            with torch.no_grad():
                sharp = self._raw(sample, {"blur": False})
            loss = (raw - sharp).square().mean() / 2
            found = torch.autograd.grad(loss, self.parameters, allow_unused=True)
        pairs = zip(found, self.parameters, strict=True)
        return Answer(raw.detach(), tuple(torch.zeros_like(p) if g is None else g for g, p in pairs))

    def _raw(self, sample: Sample, changes: Mapping[str, Any], shortcuts: Shortcuts = NOTHING) -> Tensor:
        rank = changes.get("rank")
        scene = sample.scene if rank is None else sample.low_rank(rank)
        if self.certain and changes.get("blur") is False:  # it may fill the well where blurred light does not
            return with_imaging(self._bottomless, **changes)(scene)
        if sample.places is None or not (self.imaging and self.imaging.changed(**changes).varies):
            return self._with(changes, shortcuts)(scene)
        reach, given = self.imaging.reach(sample.picture), self._always | dict(changes)
        depth = torch.as_tensor(scene.depth, dtype=torch.float64)
        if depth.ndim > 1:  # layers lie where they lie in the whole
            own = self.imaging.changed(**given)
            given["layers"] = tuple((1 / own.vergences(scene, depth)).tolist())
        raws = []
        for row, place in enumerate(sample.places):
            stages = self._with(given, shortcuts)
            parts = [s.part(place, reach=reach) if isinstance(s, Imaging) else s for s in stages]
            raws.append(Camera(*parts, context=stages.context)(scene.samples([row])))
        return torch.cat(raws)

    @functools.cached_property
    def _bottomless(self) -> Camera:
        """The raw's camera without what stops at the full well."""
        return Camera(*(s for s in self.raw_camera if not stops(s)), context=self.raw_camera.context)

    def _with(self, changes: Mapping[str, Any], shortcuts: Shortcuts = NOTHING) -> Camera:
        if shortcuts:
            return noiseless_raw(shortened(self.camera, changes, shortcuts))
        return with_imaging(self.raw_camera, **changes)

    # ---- the stages of the sensor --------------------------------------------------------------------------------

    def skippable(self) -> list[int]:
        """Indices of the stages up to the ADC that say what leaving them out would cost, and may be.

        One whose effect is of the whole picture (`whole_picture`) is kept where no trial sees that whole.
        """
        found = []
        for index, stage in enumerate(self.camera):
            trained = any(p.requires_grad for p in stage.parameters())
            unseen = getattr(stage, "each_sample", False) or (getattr(stage, "whole_picture", False) and self._crops)
            if isinstance(stage, Skippable) and not (trained or unseen or isinstance(stage, Imaging)):
                found.append(index)
            if isinstance(stage, ENDS):
                break
        return found

    @property
    def _crops(self) -> bool:
        """Whether not even the last trial sees pictures whole."""
        return any(sample.places is not None for sample in self.witnesses)

    def _signals(self, settings: Mapping[str, Any]) -> list[dict[int, tuple[Tensor, Context]]]:
        """For each row of the samples: what every stage up to the ADC is given, without noise, with these optics."""
        result = []
        with torch.no_grad():
            for sample in self.samples:
                camera = self._with(self._always | dict(settings))
                context = self.camera.resolve(sample.scene)
                given: dict[int, tuple[Tensor, Context]] = {}
                if self.index != 0:
                    given[0] = (sample.scene.bands(), context)
                for index, _, signal in camera.walk(sample.scene):
                    given[index] = (signal, context)
                result += [
                    {index: (signal[row : row + 1], told) for index, (signal, told) in given.items()}
                    for row in range(len(sample.owners))
                ]
        return result

    @property
    def dimmings(self) -> list[float]:
        """Of each signal, how many times as large errors are, relative to blurred light."""
        return self.dimmed or [1.0] * len(self.signals)

    def noise(self) -> float:
        """Sigma of all noise and half a step of the ADC, relative to the raw's RMS: of the scene that has least."""
        found: dict[int, list[float]] = {}
        for index, stage in enumerate(self.camera):
            share = 3 if isinstance(stage, ADC) else 1  # half a step is sqrt(3) of its sigma
            if isinstance(stage, (RandomStage, ADC)):
                energies: dict[int, list[float]] = {}
                for (owner, given), dimmed in zip(self._signals_by_owner, self.dimmings, strict=True):
                    energy = float(given[index][0].detach().double().square().sum())
                    part = energies.setdefault(owner, [0.0, 0.0])
                    part[0] += share * energy * stage.error_if_skipped(*given[index]) ** 2
                    part[1] += energy / dimmed**2
                for owner, (noise, energy) in energies.items():
                    found.setdefault(owner, []).append(noise / max(energy, 1e-30))
            if isinstance(stage, ENDS):
                break
        return min((math.sqrt(sum(parts)) for parts in found.values()), default=0.0)


def _error(samples: Sequence[Sample], ours: Sequence[Answer], theirs: Sequence[Answer]) -> float:
    """Relative RMS of raws, the worst over the scenes, and of gradients, over the batches.

    The crops of one scene are one picture: their squares add up.
    """
    found = [0.0]
    for sample, one, other in zip(samples, ours, theirs, strict=True):
        for rows, factor in sample.of_owners():
            if bool(other.raw[rows].any()):
                found.append(factor * relative_rms(one.raw[rows], other.raw[rows]))
        found += [relative_rms(a, b) for a, b in zip(one.gradients, other.gradients, strict=True) if bool(b.any())]
    return max(found)
