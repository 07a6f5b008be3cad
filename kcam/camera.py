"""A camera is a sequence of stages, from the light of a scene to the finished picture. No maths is done here."""

from __future__ import annotations

import dataclasses
import inspect
import os
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor, nn

from kcam import files, isp, optics, sensor
from kcam.context import Context, Stage, applied
from kcam.inputs import band_remedy, check_bands, describe
from kcam.scene import Scene
from kcam.threads import no_more_than_free
from kcam.units import mm, nm, um

if TYPE_CHECKING:
    from kcam.linear import LinearCamera
    from kcam.planner import Plan

DEMOSAICING = (isp.Demosaic, isp.LearnedDemosaic)
FINISHING = (isp.Denoise, isp.LocalToneMapping, isp.Sharpen, isp.JPEG)
PAINTING = (isp.StyleStage, isp.TextureTransfer)
DEVELOPING = (*DEMOSAICING, isp.WhiteBalance, isp.ColourMatrix, isp.ToneCurve, *FINISHING)
"""The first of these ends the raw signal."""
ORDER: tuple[type[nn.Module] | tuple[type[nn.Module], ...], ...] = (
    optics.Imaging,
    sensor.ColourFilter,
    sensor.Mosaic,
    sensor.ADC,
    DEMOSAICING,
    isp.WhiteBalance,
    isp.ColourMatrix,
    isp.ToneCurve,
)
"""Stages that a light path passes once each, in this order. All others stand any number of times: see `PLACES`."""
PIXELS = (
    sensor.MicrolensShading,
    sensor.Crosstalk,
    sensor.DefectPixels,
    sensor.DarkCurrent,
    sensor.ShotNoise,
    sensor.FixedPattern,
    sensor.ReadNoise,
    sensor.RowColumnNoise,
    sensor.Nonlinearity,
)
"""What happens to the electrons of pixels, before any of them is developed."""
Kinds = tuple[type[nn.Module], ...]
PLACES: tuple[tuple[Kinds, Kinds, Kinds], ...] = (
    ((sensor.Transmission,), (optics.Imaging,), (sensor.ColourFilter,)),
    ((sensor.Motion, optics.VeilingGlare), (optics.Imaging,), (sensor.Mosaic, *DEVELOPING)),
    (PIXELS, (optics.Imaging, sensor.ColourFilter), DEVELOPING),
    ((*FINISHING, *PAINTING), (optics.Imaging, sensor.ColourFilter, sensor.Mosaic, sensor.ADC, *DEMOSAICING), ()),
)
"""(stages, those of a camera that they stand behind, those that they stand before); all others may stand anywhere."""
_TAKES = {optics.Imaging: "a scene", sensor.ColourFilter: "bands", **dict.fromkeys(DEMOSAICING, "a mosaic")}
_LEAVES = {sensor.ColourFilter: "which leaves no bands", sensor.Mosaic: "where pixels have one colour each"}


class Camera(nn.Module):
    """A sequence of stages; ``camera(scene)`` is the picture.

    What a stage leaves open it takes from its neighbours (pattern, full well, filter, ...) and, at each call, from the
    scene (wavelengths, illuminant, luminance): both travel in one frozen `Context`. An Imaging stage takes the
    ColourFilter that follows it into its own computation, with the same result. A plain nn.Module may stand among the
    stages; it gets the signal alone.

    ``len``, iteration and indexing go over the stages. ``camera[2]`` is a stage; ``camera[:4]`` is a camera that shares
    these stages and still knows what the others said, so that ``camera[7:](camera[:7](scene))`` is ``camera(scene)``.

    Args:      stages: modules from tensor to tensor, in the order of the light.
               context: what holds where no stage and no scene says otherwise; by default `Context()`.
    Raises:    TypeError for a stage that is no module; ValueError if two stages contradict each other, or stand in an
               order that cannot work.

    Example:
    >>> camera = Camera(sensor.ColourFilter.kodak(), sensor.Mosaic("GBRG"), sensor.Exposure(), isp.Demosaic(),
    ...                 isp.WhiteBalance(), isp.ColourMatrix(), isp.ToneCurve())
    >>> white = camera(Scene.from_rgb(torch.ones(3, 8, 8), depth=2.0))
    >>> white.shape, bool((white - 1).abs().max() < 0.01)
    (torch.Size([1, 3, 8, 8]), True)
    """

    def __init__(self, *stages: nn.Module, context: Context | None = None) -> None:
        super().__init__()
        for index, stage in enumerate(stages):
            if not isinstance(stage, nn.Module):
                hint = f"Call it: {stage.__name__}(...)." if isinstance(stage, type) else "Wrap it in an nn.Module."
                raise TypeError(f"stage {index} of the camera is {stage!r}, which is not an nn.Module. {hint}")
        _check_order(stages)
        self.stages = nn.ModuleList(stages)
        self.context = context
        self.resolve()

    def resolve(self, scene: Scene | Tensor | None = None, *, generator: torch.Generator | None = None) -> Context:
        """What the stages are told when they see this scene: their neighbours' settings, and the scene's light.

        Raises:    ValueError if two stages contradict each other.
        """
        given: dict[str, tuple[Any, str]] = {}
        for index, stage in enumerate(self.stages):
            for name, value in stage.provides().items() if isinstance(stage, Stage) else ():
                here = f"{type(stage).__name__} (stage {index})"
                if name == "read_noise" and name in given:  # independent noises add up, they do not contradict
                    given[name] = ((value**2 + given[name][0] ** 2) ** 0.5, here)
                    continue
                other, there = given.setdefault(name, (value, here))
                if not _same(value, other):
                    raise ValueError(
                        f"two stages contradict each other: {there} has {name} = {_short(other)}, {here} has "
                        f"{name} = {_short(value)}. Give it to one of them only; the other takes it over."
                    )
        fields = {name: value for name, (value, _) in given.items()}
        glasses: Any = self._transmissions()
        told: Any = self.context and self.context.colour_filter
        own: Any = fields.get("colour_filter")
        if _same_curves(told, own) and all(any(glass is one for one in told.transmissions) for glass in glasses):
            fields["colour_filter"] = told  # a part of a camera that had glasses before the filter
        elif glasses:
            fields["colour_filter"] = own.behind(*glasses)
        if self.context is not None and isinstance(fields.get("read_noise"), float):  # of a part, others are outside it
            fields["read_noise"] = max(fields["read_noise"], float(self.context.read_noise))
        if isinstance(scene, Scene):
            fields |= {name: getattr(scene, name) for name in ("wavelengths", "illuminant", "luminance", "depth")}
        return dataclasses.replace(self.context or Context(), **fields, generator=generator)

    def _transmissions(self) -> list[sensor.Transmission]:
        """Those before the filter; none where there is no filter."""
        stages = list(self.stages)
        end = next((index for index, stage in enumerate(stages) if isinstance(stage, sensor.ColourFilter)), 0)
        return [stage for stage in stages[:end] if isinstance(stage, sensor.Transmission)]

    @no_more_than_free()
    def forward(
        self,
        scene: Scene | Tensor,
        *,
        generator: torch.Generator | None = None,
        tolerance: float | str | None = None,
    ) -> Tensor:
        """Take a picture.

        Args:      scene: a Scene, or its bands (B,L,H,W) at the context's wavelengths.
                   generator: source of all noise; None for torch's default one.
                   tolerance: None for the reference physics; else the picture is planned for where that pays: see
                   `kcam.planner.shoot`.
        Returns:   (B,C,H,W), what the last stage gives: sRGB in [0,1] from a camera that ends in ToneCurve.
        Raises:    TypeError for anything else than a scene or a tensor, or a generator that is none; ValueError for a
                   tolerance where gradients are recorded: training must not plan anew at each step.
        """
        if tolerance is not None:
            if torch.is_grad_enabled() and any(p.requires_grad for p in self.parameters()):
                raise ValueError(
                    "tolerance= plans afresh at each call, which training must not: a plan is explicit there. Use "
                    "plan = camera.plan(scene, tolerance=...) once and plan.apply(camera)(scene), or torch.no_grad()."
                )
            if not isinstance(scene, Scene):
                raise TypeError(f"tolerance= plans for a Scene, got {type(scene).__name__}. Use Scene.from_bands(...).")
            from kcam.planner import shoot

            return shoot(self, scene, tolerance=tolerance, generator=generator)[0]
        picture: Any = scene.bands() if isinstance(scene, Scene) and not len(self) else scene
        for _, picture in self.steps(scene, generator=generator):  # noqa: B007 (the last one stays)
            pass
        return picture

    def steps(self, scene: Scene | Tensor, *, generator: torch.Generator | None = None) -> Iterator[tuple[str, Tensor]]:
        """Take a picture stage by stage: (name of the stage, its signal (B,C,H,W)), each computed when asked for.

        An Imaging that absorbs the filter after it is one step, "Imaging + ColourFilter". Arguments: as `forward`.
        """
        for _, name, signal in self.walk(scene, generator=generator):
            yield name, signal

    def walk(
        self, scene: Scene | Tensor, *, generator: torch.Generator | None = None
    ) -> Iterator[tuple[int, str, Tensor]]:
        """As `steps`, with the number of stages that are behind each signal."""
        if not isinstance(scene, (Scene, Tensor)):
            if isinstance(scene, (list, tuple)) and any(isinstance(one, Scene) for one in scene):
                raise TypeError(
                    f"a camera takes one Scene, got {describe(scene)}. Use [camera(scene) for scene in scenes], or one "
                    "Scene of a batch (B,3,H,W)."
                )
            raise TypeError(
                f"a camera takes a Scene or a tensor (B,L,H,W), got {describe(scene)}. Use "
                "Scene.from_rgb(image, depth=2.0) or Scene.from_file(path, depth=2.0)."
                f"{band_remedy(scene, name='image', bands=len(self.resolve().wavelengths))}"
            )
        if not (generator is None or isinstance(generator, torch.Generator)):
            raise TypeError(
                f"generator must be a torch.Generator, got {generator!r}. Use torch.Generator().manual_seed(0)."
            )
        context = self.resolve(scene, generator=generator)
        if isinstance(scene, Tensor) and len(self) and isinstance(self[0], (optics.Imaging, sensor.ColourFilter)):
            check_bands(scene, name="image", count=len(context.wavelengths), ndims=(4,), sure=False)
        signal: Any = scene
        stages, count = list(self), 0
        while count < len(stages):
            stage = stages[count]
            taken, colour_filter = self.absorbed(count)
            together = stages[count : count + 1 + taken]
            if colour_filter is not None:
                signal = applied(stage, signal, context, colour_filter=colour_filter)
            else:
                if isinstance(signal, Scene) and not isinstance(stage, optics.Imaging):
                    signal = signal.bands()
                signal = applied(stage, signal, context)
            count += 1 + taken
            yield count, " + ".join(type(stage).__name__ for stage in together), signal

    def absorbed(self, index: int) -> tuple[int, sensor.ColourFilter | None]:
        """How many stages behind one it takes into its own computation, and as what filter: an Imaging takes that which
        follows it, behind the transmissions before it.

        Example:
        >>> [Camera.phone().absorbed(index)[0] for index in (0, 1)]
        [1, 0]
        """
        stages = list(self)[index:]
        glasses: list[Any] = []
        for stage in stages[1:] if isinstance(stages[0], optics.Imaging) else ():
            if isinstance(stage, sensor.ColourFilter):
                return len(glasses) + 1, stage.behind(*glasses) if glasses else stage
            if not isinstance(stage, sensor.Transmission):
                break
            glasses.append(stage)
        return 0, None

    def raw(self, scene: Scene | Tensor, *, generator: torch.Generator | None = None) -> Tensor:
        """What the sensor recorded: the signal just before the demosaic, (B,1,H,W), or (B,C,H,W) of full planes; behind
        an ADC 1.0 is full scale. Arguments: as `forward`.

        Without a demosaic, such as of a monochrome sensor, it ends before white balance, colour matrix or tone curve,
        else with the last stage.
        """
        end = next((index for index, stage in enumerate(self) if isinstance(stage, DEVELOPING)), len(self))
        return self[:end](scene, generator=generator)

    def burst(
        self,
        scene: Scene | Tensor,
        *,
        exposures: Sequence[float],
        motion: sensor.Motion | None = None,
        interval: float = 0.0,
        generator: torch.Generator | None = None,
    ) -> Tensor:
        """Take several pictures one after the other: a burst of equal exposures, or a bracket of unequal ones.

        The still image is computed once, and the motion goes on from picture to picture. Each draws its noise from a
        generator of its own, whose seed `generator` draws: picture k of two bursts has the same seed, whatever else
        they are. What is fixed of the sensor is the same in all.

        Args:      exposures: of each picture: seconds for a camera with ``Exposure(time=...)``, else times the camera's
                   own automatic exposure, such as (0.25, 1, 4).
                   motion: of a velocity, a translation or a flow, put before the mosaic. Its time is the exposure
                   where that is in seconds, else its own. None: nothing moves.
                   interval: from the end of one exposure, with its readout, to the start of the next [s].
                   generator: source of all noise; None for torch's default one.
        Returns:   (N,B,C,H,W): N pictures as `forward` gives them.
        Raises:    ValueError for no exposures, or some that are not > 0, a camera without an Exposure, or with a Motion
                   of its own beside `motion`, and a motion along a path, which has an end; TypeError for exposures that
                   are no list of numbers, or no Motion.

        Example:
        >>> bracket = Camera.phone().burst(Scene.builtin("coffee", size=32), exposures=[0.25, 1.0, 4.0])
        >>> bracket.shape, bool(bracket[0].mean() < bracket[1].mean() < bracket[2].mean())
        (torch.Size([3, 1, 3, 21, 32]), True)
        """
        from kcam.burst import burst

        return burst(self, scene, exposures=exposures, motion=motion, interval=interval, generator=generator)

    def linear(self, scene: Scene) -> LinearCamera:
        """The linear part of the camera, from a scene's light to its raw signal, as an operator with its transpose.

        raw = A x + offset + noise,   A = gain mosaic filter imaging

        A holds all that is linear in the light: PSFs, their variation over the field, distortion, occlusion (which a
        depth map decides, not the light), filter, mosaic, exposure, gain. Noise, saturation and rounding are left out,
        black level and dark current are its `offset`. It ends where `raw` does; without a demosaic before the white
        balance, else with the last stage.

        Args:      scene: what the operator is for. Its depth, spectra, light, luminance and size are kept; by its
                   picture is decided, once, what an Imaging decides by the look of a scene: whether it is computed in
                   float64, how finely depth is cut, at how many places of the field PSFs are computed. Automatic
                   exposure goes by the scene's white, not by its picture.
        Returns:   A: ``A(x)`` or ``A.forward(x)``, ``A.adjoint(y)``, ``A.norm()``; x (B,K,H,W) are coefficient planes
                   as in `Scene`, of any sign: for a picture three of linear sRGB, for a cube its bands; ``A.light`` are
                   the scene's own, for which ``A(x) + A.offset`` is ``noiseless().raw(scene)`` without limits and
                   steps. y (B,C,H,W), 1.0 = full scale.
        Raises:    TypeError for what is no Scene; ValueError for a stage before the raw that is not linear, and for an
                   Imaging of a plan that lowers the rank of each scene.
        Valid where no pixel saturates; of a plain nn.Module before the raw as far as three signals can tell.
        Source:    for what to do with it, Chambolle and Pock, J. Math. Imaging Vis. 40 (2011): total variation by A and
                   its transpose. The latter is the vector-Jacobian product, exact since A is linear.
        """
        from kcam.linear import LinearCamera

        return LinearCamera(self, scene)

    def noiseless(self) -> Camera:
        """The same camera with every random stage at its mean; it shares the parameters."""
        return Camera(*(_at_mean(stage) for stage in self), context=self.resolve())

    def plan(self, scenes: Scene | Sequence[Scene], *, tolerance: float | str, max_memory: float | None = None) -> Plan:
        """What to simulate for these scenes to stay within a tolerance: `kcam.planner.make_plan`."""
        from kcam.planner import make_plan

        return make_plan(self, scenes, tolerance=tolerance, max_memory=max_memory)

    def explain(
        self, scene: Scene, *, tolerance: float | str, measure: bool = False, max_memory: float | None = None
    ) -> Plan:
        """The plan for a scene, and with `measure` its true error and time: `kcam.planner.explain`."""
        from kcam.planner import explain

        return explain(self, scene, tolerance=tolerance, measure=measure, max_memory=max_memory)

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write weights and configuration into one .safetensors file; `kcam.files.describe` reads the latter back.

        Stages may be kcam's, torch's own layers (`kcam.layers.NAMES`: Sequential, convolutions, Linear, norms,
        activations, pooling, upsampling, ...), and classes of yours that keep their constructor's arguments.

        Raises:    as `kcam.files.save`: ValueError for other layers of torch's, TypeError for classes of yours that
                   cannot be built again.
        """
        from kcam import __version__

        files.save(self, path, classes=_classes(), version=__version__)

    @classmethod
    def load(cls, path: str | os.PathLike[str], *, custom: Sequence[type[nn.Module]] = ()) -> Camera:
        """Read a camera that `save` wrote; it takes the same pictures, bit for bit.

        Args:      custom: classes of stages that are not kcam's own. No other code is ever run.
        Raises:    FileNotFoundError, ValueError: see `kcam.files.load`.
        """
        file = Path(path)
        run = file if file.is_dir() else file.with_suffix("")
        if not file.is_file() and (run / "checkpoints").is_dir():  # `kcam train` writes the camera last of all
            raise FileNotFoundError(
                f"{file} is no camera yet: its training was stopped. Go on with the same kcam train ... --resume."
            )
        camera = files.load(path, classes=_classes(custom))
        if not isinstance(camera, Camera):
            raise ValueError(f"{path} holds a {type(camera).__name__}, not a Camera.")
        return camera

    @staticmethod
    def thesis() -> Camera:
        """The thesis's network, layer by layer (its figure 4.1): 28 bands, a DOE to learn, a filter tile to learn.

        A plano-convex lens of N-BK7 (R = 25.8 mm, 5 mm aperture) in focus at 2 m, an 891 x 891 DOE in fused silica,
        Fresnel PSFs of 297 x 297 pixels, a 28 x 28 tile of twelve Gaussians, and a 3 x 3 convolution to three channels,
        which plays the demosaic. Before training the DOE is flat and the convolution a local mean, slightly
        disturbed, so that the picture is soft and without colour but for a cast of lilac.
        """
        lens = optics.Lens(
            optics.CircularAperture(diameter=5 * mm),
            optics.PlanoConvexLens(radius_of_curvature=25.8 * mm, glass="N-BK7"),
            optics.DOE(nn.Parameter(torch.zeros(891, 891)), design_wavelength=550 * nm, glass="fused silica"),
            focus_distance=2.0,
        )
        return Camera(
            optics.Imaging(lens, pixel_pitch=4 * um, propagator="fresnel", psf_shape=(297, 297)),
            sensor.ColourFilter.learned(tile=28),
            sensor.Exposure(),
            isp.Clip(),
            isp.LearnedDemosaic(),
            isp.ToneCurve(),
        )

    @staticmethod
    def ideal() -> Camera:
        """A camera without optics, mosaic or noise: three full channels (Nikon 5100), for comparison.

        Its colours are a camera's, not the scene's: the colour matrix maps the filter's channels to sRGB as well as
        three numbers can, to a mean delta-E 2000 of 0.9 over the 24 patches, and up to 2.9.
        """
        return Camera(
            sensor.ColourFilter.nikon(),
            sensor.Exposure(),
            isp.WhiteBalance(),
            isp.ColourMatrix(),
            isp.ToneCurve(),
        )

    @staticmethod
    def phone() -> Camera:
        """A phone's main camera: 4.3 mm f/1.8 in focus at 2 m, 1.4 um pixels in RGGB, 10 bits, and its noise."""
        lens = optics.Lens(
            optics.CircularAperture(diameter=4.3 * mm / 1.8),
            optics.ThinLens(focal_length=4.3 * mm),
            focus_distance=2.0,
        )
        return Camera(optics.Imaging(lens, pixel_pitch=1.4 * um), *_rgb_sensor(full_well=6_000, read_noise=2.0))

    @staticmethod
    def phone_lens() -> Camera:
        """A phone's camera with a real lens, over its whole field: three aspheres of 3.74 mm f/2.8 (`CompoundLens`
        "phone") in focus at 2 m, 0.9 um pixels; the lens reaches as far as 4000 x 3000 of them.
        """
        lens = optics.CompoundLens.preset("phone", focus_distance=2.0)
        *taken, demosaic, balance, matrix, tones = _rgb_sensor(full_well=4_500, read_noise=1.5)
        developed = [demosaic, isp.Denoise(), balance, matrix, isp.LocalToneMapping(), tones, isp.Sharpen(), isp.JPEG()]
        return Camera(optics.Imaging(lens, pixel_pitch=0.9 * um), *taken, *developed)

    @staticmethod
    def slr() -> Camera:
        """A full-frame camera of 4368 x 2912 pixels of 8.2 um behind a real 50 mm at f/4 (`CompoundLens` "ef50"), in
        focus at 5 m, 12 bits.
        """
        lens = optics.CompoundLens.preset("ef50", focus_distance=5.0)
        stop = lens.surfaces[lens.stop]
        stop.semi_diameter = float(stop.semi_diameter) * lens.f_number / 4  # type: ignore[arg-type]
        sensor_ = _rgb_sensor(full_well=60_000, read_noise=4.0, bits=12, black_level=128)
        return Camera(optics.Imaging(lens, pixel_pitch=8.2 * um), *sensor_)

    @classmethod
    def preset(cls, name: str) -> Camera:
        """A camera by the name of its preset, see the methods: "thesis", "ideal", "phone", "phone_lens" or "slr"."""
        if name not in PRESETS:
            raise ValueError(f"unknown preset {name!r}. There are: {', '.join(PRESETS)}.")
        return PRESETS[name]()

    def __len__(self) -> int:
        return len(self.stages)

    def __iter__(self) -> Iterator[nn.Module]:
        return iter(self.stages)

    def __getitem__(self, key: int | slice) -> Any:
        if isinstance(key, slice):
            return Camera(*self.stages[key], context=self.resolve())
        return self.stages[key]


PRESETS: dict[str, Callable[[], Camera]] = {
    "thesis": Camera.thesis,
    "ideal": Camera.ideal,
    "phone": Camera.phone,
    "phone_lens": Camera.phone_lens,
    "slr": Camera.slr,
}


def _rgb_sensor(*, full_well: float, read_noise: float, bits: int = 10, black_level: int = 64) -> list[nn.Module]:
    """All behind the lens, from the colour filter to sRGB."""
    return [
        sensor.ColourFilter.nikon(),
        sensor.Mosaic("RGGB"),
        sensor.Exposure(),
        sensor.ShotNoise(full_well=full_well),
        sensor.ReadNoise(read_noise),
        sensor.ADC(bits=bits, black_level=black_level),
        isp.Demosaic(),
        isp.WhiteBalance(),
        isp.ColourMatrix(),
        isp.ToneCurve(),
    ]


def _check_order(stages: Sequence[nn.Module]) -> None:
    last, previous = -1, ""
    for stage in stages:
        rank = next((rank for rank, cls in enumerate(ORDER) if isinstance(stage, cls)), None)
        if rank is None:
            continue
        name = type(stage).__name__
        if rank == last:
            raise ValueError(f"the camera has two {name} stages: light passes one. Remove one of them.")
        if rank < last:
            raise ValueError(f"{name} stands after {previous}, but light passes it first. Move it before {previous}.")
        last, previous = rank, name
    for index, stage in enumerate(stages):
        name = type(stage).__name__
        for behind, before in ((behind, before) for kinds, behind, before in PLACES if isinstance(stage, kinds)):
            for other in reversed(stages[index + 1 :]):
                if kind := _acts_as(other, behind):
                    there, takes = type(other).__name__, _TAKES.get(kind, "the sensor's signal")
                    raise ValueError(f"{name} stands before {there}, which takes {takes}. Move it behind {there}.")
            for other in stages[:index]:
                if kind := _acts_as(other, before):
                    there, why = type(other).__name__, _LEAVES.get(kind, "where the raw signal has ended")
                    raise ValueError(f"{name} stands after {there}, {why}. Move it before {there}.")
    _check_planes(stages)


def _acts_as(stage: nn.Module, kinds: Kinds) -> type[nn.Module] | None:
    """Which of them it is; a filter that is a tile is a mosaic."""
    if sensor.Mosaic in kinds and isinstance(stage, sensor.ColourFilter) and stage.is_tile:
        return sensor.Mosaic
    return next((kind for kind in kinds if isinstance(stage, kind)), None)


def _check_planes(stages: Sequence[nn.Module]) -> None:
    """Where pixels have one colour each, and where they have all there is."""
    mosaiced = gray = False
    for stage in stages:
        name = type(stage).__name__
        if gray and isinstance(stage, (sensor.Mosaic, *DEMOSAICING)):
            raise ValueError(
                f"a monochrome camera needs no {name}: behind a ColourFilter of one curve each pixel has all there is. "
                f"Leave {name} out."
            )
        if mosaiced and isinstance(stage, FINISHING):
            raise ValueError(
                f"{name} stands on a mosaic, where pixels have one colour each. Put isp.Demosaic() before."
            )
        if _acts_as(stage, (sensor.Mosaic,)):
            mosaiced = True
        elif isinstance(stage, sensor.ColourFilter):
            gray = stage.output_channels(0) == 1
        elif not (type(stage).__module__.startswith("kcam.sensor.") or isinstance(stage, isp.Clip)):
            mosaiced = gray = False  # what it makes of the planes is its own


def _same_curves(told: Any, own: Any) -> bool:
    """Whether one is the other, maybe behind glass."""
    return all(isinstance(one, sensor.ColourFilter) for one in (told, own)) and told.coefficients is own.coefficients


def is_random(stage: nn.Module) -> bool:
    """Whether a stage draws noise, and so has a mean."""
    return isinstance(stage, Stage) and callable(getattr(stage, "mean", None))


def _at_mean(stage: Any) -> nn.Module:
    return stage.mean() if is_random(stage) else stage


def _same(value: Any, other: Any) -> bool:
    """Equal numbers and strings, equal tensors, the same module."""
    if isinstance(value, Tensor) or isinstance(other, Tensor):
        a, b = torch.as_tensor(value).detach(), torch.as_tensor(other).detach()
        return a.shape == b.shape and bool((a.double().cpu() == b.double().cpu()).all())
    return value is other or bool(value == other)


def _short(value: Any) -> str:
    text = repr(value.detach().tolist() if isinstance(value, Tensor) and value.numel() == 1 else value)
    return text if len(text) <= 60 else f"{text[:57]}..."


def _classes(custom: Sequence[type[nn.Module]] = ()) -> dict[str, type]:
    """Every class that a saved camera may hold: kcam's public modules and glasses, and those that the caller names."""
    table: dict[str, type] = {"Camera": Camera, "Context": Context, "optics.Glass": optics.Glass}
    for module in (optics, sensor, isp):
        for name, cls in vars(module).items():
            if inspect.isclass(cls) and issubclass(cls, nn.Module) and cls.__module__.startswith("kcam."):
                table[f"{module.__name__.removeprefix('kcam.')}.{name}"] = cls
    return table | {cls.__qualname__: cls for cls in custom}
