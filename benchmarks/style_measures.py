"""How far a shot is from an ordinary picture towards a style, and how much of its scene is left.

Independent of what cameras are trained on: nothing here comes from kcam.style. Pictures are (3, H, W) sRGB in [0, 1],
of any sizes from 64 pixels; gray is the Rec.709 luma of the coded values, everywhere.

No single figure tells a good shot. A histogram match closes most of the gap in `patch_swd` and none in
`oriented_texture`; a blend with the style picture closes both, and `wallpaper` gives it away; a shot that is all
strokes loses `detail_correlation`. Every figure is the same from run to run: the projections are seeded.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterable
from functools import lru_cache
from math import ceil, pi

import numpy as np
import torch
from kornia.color import linear_rgb_to_rgb, rgb_to_linear_rgb
from matplotlib.cbook import get_sample_data
from PIL import Image
from scipy.stats import rankdata
from skimage import data
from skimage.exposure import match_histograms
from torch import Tensor
from torch.nn.functional import conv2d, grid_sample, interpolate, pad

PATCH, PROJECTIONS = 7, 128
STRIDES = {1: 3, 2: 1, 4: 1}  # of the patches, by level: odd, so that no colour lattice is met in one phase only
WAVELENGTHS, DIRECTIONS = (4, 8, 16), 8
ONE_OCTAVE = 0.56  # the envelope's sigma, in wavelengths, of a Gabor filter one octave wide
HIGH_PASS = 2.0  # sigma of what `wallpaper` takes away: it leaves the edges of strokes, not where scenes are bright
DETAIL = (2.0, 8.0)
QUANTILES = 2048
SLOPE, AVERAGED = 1.0, 2.0  # sigmas of a structure tensor's slopes and of its average
WALK, EVERY = 32, 3  # pixels each way at most, and from one walk to the next
LEAVES = 0.35  # of the deviation of colours: another colour
BESIDE = 4.0  # pixels along and across
FINEST = 0.7  # sigma of what is finer than a stroke's edge
EDGE, HALO = (2.0, 0.1), (4.0, 14.0)  # sigma and share of the scene's edges; pixels from them
EVEN_SIDES = 0.15  # of an edge's step, that its sides may vary by
FACES = {"hopper": (0.16, 0.60, 0.33, 0.69)}  # top, bottom, left, right, of the side
SMALLEST = 64  # pixels: the widest filter's reach, 3 sigma of 16 pixels, must fit for the border to be reflected


def patch_swd(picture: Tensor, other: Tensor) -> float:
    """Sliced Wasserstein distance between the 7 x 7 patches of two pictures, the mean over levels 1, 1/2 and 1/4.

    Patches are from the whole picture, overlapping: each at 1/2 and 1/4, every third along rows and columns at 1.
    """
    return _apart(_patches(picture), _patches(other))


def oriented_texture(picture: Tensor, other: Tensor) -> float:
    """Sliced Wasserstein distance between the local oriented energies of two pictures.

    Gray values become ranks first, so neither colour nor any tone curve counts. The amplitudes of 8 directions are
    sorted at each pixel and wavelength (4, 8, 16 pixels): how directed, how coarse, not which way.
    """
    return _apart(_energies(picture), _energies(other))


def luminance_correlation(picture: Tensor, scene: Tensor) -> float:
    """Pearson correlation of coded Rec.709 luma."""
    _check_same_size(picture, scene)
    return _correlation(_luma(picture), _luma(scene))


def detail_correlation(picture: Tensor, scene: Tensor) -> float:
    """Pearson correlation of luma between Gaussians of sigma 2 and 8 pixels: where faces are, or are no more."""
    _check_same_size(picture, scene)
    return _correlation(*(_blur(_luma(x), DETAIL[0]) - _blur(_luma(x), DETAIL[1]) for x in (picture, scene)))


def wallpaper(pictures: Iterable[Tensor]) -> float:
    """The largest absolute correlation between shots of different scenes of their luma less a Gaussian of sigma 2.

    All are cropped to the common size from the top left, where a pattern that does not know the scene begins.
    """
    gray = [_luma(picture) for picture in pictures]
    if len(gray) < 2:
        raise ValueError(f"wallpaper compares shots of different scenes: give two or more, not {len(gray)}")
    height, width = (min(g.shape[axis] for g in gray) for axis in (0, 1))
    high = [g - _blur(g, HIGH_PASS) for g in (g[:height, :width] for g in gray)]
    return max(abs(_correlation(a, b)) for a, b in itertools.combinations(high, 2))


def face_correlation(picture: Tensor, scene: Tensor, box: tuple[float, float, float, float]) -> float:
    """`detail_correlation` within a box, by shares of the side, from 1 pixel instead of 2: eyes, nose and mouth."""
    _check_same_size(picture, scene)
    height, width = picture.shape[-2:]
    rows, columns = (slice(round(a * n), round(b * n)) for a, b, n in ((*box[:2], height), (*box[2:], width)))
    fine = [_blur(_luma(x), DETAIL[0] / 2) - _blur(_luma(x), DETAIL[1]) for x in (picture, scene)]
    return _correlation(*(x[rows, columns] for x in fine))


def halo(picture: Tensor, scene: Tensor) -> float:
    """By how much light and dark overshoot 4 pixels beside the scene's steps, of the step between 14 pixels either way.

    Only where the scene itself is a step: an edge with even sides. Strokes average out over all edges.
    """
    _check_same_size(picture, scene)
    gray = _blur(_luma(scene), EDGE[0])
    dy, dx = torch.gradient(gray)
    slope = (dx.square() + dy.square()).sqrt()
    edges = slope >= slope.flatten().sort().values[-round(EDGE[1] * slope.numel())]
    at = edges.nonzero().double()
    normal = torch.stack([dy[edges], dx[edges]], -1) / slope[edges][:, None]

    def profile(luma: Tensor) -> tuple[Tensor, Tensor]:
        """Overshoot, and step, from dark to light."""
        near, far = ([_sampled(luma[None], at + side * d * normal)[0] for side in (1, -1)] for d in HALO)
        return ((near[0] - far[0]) + (far[1] - near[1])) / 2, far[0] - far[1]

    over, step = profile(gray)
    steps = (step > 0) & (over.abs() < EVEN_SIDES * step)
    over, step = (part[steps] for part in profile(_luma(picture)))
    return float(over.mean() / step.abs().mean().clamp(min=1e-6)) if len(step) else 0.0


def stroke_length(picture: Tensor) -> float:
    """How far one can walk along the local direction, both ways, until the colour is another one [pixel], on average.

    Another one: by 0.35 of the deviation of all colours, so that contrast does not count. At most 64.
    """
    colours, directions, _ = _strokes(picture)
    start = _places(colours)
    first = _sampled(colours, start)
    length = torch.zeros(len(start), dtype=torch.float64)
    for sense in (1.0, -1.0):
        at, going = start.clone(), sense * _along(directions, start)
        walks = torch.ones(len(start), dtype=torch.bool)
        for _ in range(WALK):
            at = at + going
            turned = _along(directions, at)
            going = turned * (turned * going).sum(-1, keepdim=True).sign()
            inside = ((at >= 0) & (at <= torch.tensor(colours.shape[-2:]) - 1)).all(-1)
            walks &= inside & ((_sampled(colours, at) - first).norm(dim=0) < LEAVES)
            length += walks
    return float(length.mean())


def along_across(picture: Tensor) -> float:
    """Colours' mean difference over 4 pixels along the local direction, of that across: what a stroke keeps as one."""
    colours, directions, _ = _strokes(picture)
    start = _places(colours)
    along = _along(directions, start)
    across = torch.stack([-along[:, 1], along[:, 0]], -1)
    here = _sampled(colours, start)
    apart = [(_sampled(colours, start + BESIDE * way) - here).norm(dim=0).mean() for way in (along, across)]
    return float(apart[0] / apart[1].clamp(min=1e-9))


def coherence(picture: Tensor, other: Tensor) -> float:
    """Wasserstein distance between the coherences of two pictures' structure tensors: 0 of no direction, 1 of one."""
    return _apart(*([_quantiles(_strokes(x)[2].flatten()[None])] for x in (picture, other)))


def pixel_noise(picture: Tensor) -> float:
    """Luma less its Gaussian of 0.7 pixels, of the luma's deviation: mazes and grain, finer than a stroke's edge."""
    gray = _luma(picture)
    return float((gray - _blur(gray, FINEST)).std() / gray.std().clamp(min=1e-6))


def seen(shot: Tensor, *, scene: Tensor, style: Tensor, face: tuple[float, ...] | None = None) -> dict[str, float]:
    """What the eye sees of strokes, beside the style's own: ratios, 1 being the style; see each measure."""
    ratios = {f.__name__: f(shot) / f(style) for f in (stroke_length, along_across, pixel_noise)}
    row = {**ratios, "coherence": coherence(shot, style), "halo": halo(shot, scene)}
    return row if face is None else {**row, "face": face_correlation(shot, scene, face)}


def _strokes(picture: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Colours over their deviation (3,H,W), directions at twice the angle (2,H,W), coherence (H,W)."""
    picture = _checked(picture).double()
    dy, dx = torch.gradient(_blur(_luma(picture), SLOPE))
    xx, xy, yy = (_blur(part, AVERAGED) for part in (dx * dx, dx * dy, dy * dy))
    twice = torch.stack([yy - xx, -2 * xy])  # of the level lines
    energy = xx + yy
    colours = picture - picture.flatten(1).mean(1)[:, None, None]
    return colours / colours.square().sum(0).mean().sqrt().clamp(min=1e-6), twice, twice.norm(dim=0) / (energy + 1e-9)


def _places(planes: Tensor) -> Tensor:
    """Rows and columns (N,2) of every third pixel each way."""
    rows, columns = (torch.arange(EVERY // 2, side, EVERY, dtype=torch.float64) for side in planes.shape[-2:])
    return torch.cartesian_prod(rows, columns)


def _sampled(planes: Tensor, at: Tensor) -> Tensor:
    """Planes (C,H,W) at rows and columns (N,2), between pixels by lines, (C,N)."""
    height, width = planes.shape[-2:]
    grid = torch.stack([at[:, 1] * 2 / (width - 1), at[:, 0] * 2 / (height - 1)], -1) - 1
    return grid_sample(planes[None], grid[None, None], padding_mode="border", align_corners=True)[0, :, 0]


def _along(directions: Tensor, at: Tensor) -> Tensor:
    """Unit steps (row, column) along the local direction, (N,2)."""
    cos, sin = _sampled(directions, at)
    angle = torch.atan2(sin, cos) / 2
    return torch.stack([angle.sin(), angle.cos()], -1)


def gap_closed(value: float, *, ordinary: float, other: float) -> float:
    """1 where the shot is as near to the style as another picture in it, 0 where it is as far as an ordinary one."""
    if other >= ordinary:
        raise ValueError(f"no gap to close: an ordinary picture ({ordinary:.3g}) is as near as the style ({other:.3g})")
    return (ordinary - value) / (ordinary - other)


def measure(shot: Tensor, *, scene: Tensor, ordinary: Tensor, style: Tensor, other_style: Tensor) -> dict[str, float]:
    """All that one shot tells.

    Args:      shot: the picture to judge. scene: what was photographed. ordinary: an ordinary camera's picture of it.
               style, other_style: the style picture and another crop of it, or another picture in the style.
    Returns:   the gaps closed in patch SWD and oriented texture, and the two correlations with the scene.
    """
    closed = {}
    for name, features in (("patch_swd", _patches), ("oriented_texture", _energies)):
        target = features(style)
        value, far, near = (_apart(features(picture), target) for picture in (shot, ordinary, other_style))
        closed[name] = gap_closed(value, ordinary=far, other=near)
    return {
        **closed,
        "luminance_correlation": luminance_correlation(shot, scene),
        "detail_correlation": detail_correlation(shot, scene),
    }


def photographs(size: int | None = 256) -> dict[str, Tensor]:
    """Photographs that are none of kcam's built-in scenes and come with packages it needs anyway.

    Args:      size: of the side [pixel], shrunk in linear light; None leaves the squares at their own pixels.
    """
    with get_sample_data("grace_hopper.jpg") as file, Image.open(file) as image:
        hopper = np.asarray(image.convert("RGB"))
    squares = {
        "hopper": hopper[20:532],
        "rocket": data.rocket()[:, 107:534],
        "retina": data.retina()[265:1145, 170:1050],  # within the round field: no black corners
    }
    pictures = {name: torch.from_numpy(x.copy()).permute(2, 0, 1).float() / 255 for name, x in squares.items()}
    return pictures if size is None else {name: _resized(x, size) for name, x in pictures.items()}


def histogram_match(photo: Tensor, style: Tensor) -> Tensor:
    """The photograph with each channel's histogram taken from the style: all that colour alone can do."""
    return torch.from_numpy(match_histograms(photo.numpy(), style.numpy(), channel_axis=0)).float()


def blend(photo: Tensor, style: Tensor) -> Tensor:
    """Half the photograph, half the style picture's top left corner: texture that does not know the scene."""
    height, width = photo.shape[-2:]
    if style.shape[-2] < height or style.shape[-1] < width:
        raise ValueError(f"the style picture {tuple(style.shape)} must cover the photograph {tuple(photo.shape)}")
    return (photo + style[:, :height, :width]) / 2


def _patches(picture: Tensor) -> list[np.ndarray]:
    picture = _checked(picture).float()
    directions = _directions(3 * PATCH**2).reshape(PROJECTIONS, 3, PATCH, PATCH)
    answers = []
    for factor, stride in STRIDES.items():
        side = [length // factor for length in picture.shape[-2:]]
        level = interpolate(picture[None], side, mode="bilinear", antialias=True)
        answers.append(_quantiles(conv2d(level, directions, stride=stride)[0].flatten(1)))
    return answers


def _energies(picture: Tensor) -> list[np.ndarray]:
    gray = _luma(picture)
    ranks = (rankdata(gray.numpy()).reshape(gray.shape) - 0.5) / gray.numel()
    ranks = torch.from_numpy(ranks).float()
    amplitudes = []
    for wavelength in WAVELENGTHS:
        # the filter's own answer to a constant is 0.002 of it, more than some texture
        waves = _gabor(ranks - _blur(ranks, ONE_OCTAVE * wavelength), wavelength)
        # neighbours say the same where the least sigma is 4 pixels: every second one will do
        energy = _blur(waves.square().sum(1), wavelength, stride=2)
        amplitudes.append(energy.sqrt().sort(0).values)
    vectors = torch.cat(amplitudes).flatten(1)
    return [_quantiles(_directions(len(vectors)) @ vectors)]


def _gabor(plane: Tensor, wavelength: float) -> Tensor:
    """Answers (directions, 2, H, W) to cosine and sine waves under a Gaussian, round, so that rows and columns part."""
    t = _offsets(ONE_OCTAVE * wavelength)
    envelope = _gaussian(ONE_OCTAVE * wavelength)
    angles = torch.arange(DIRECTIONS) * pi / DIRECTIONS
    phase_x, phase_y = (2 * pi / wavelength * f(angles)[:, None] * t for f in (torch.cos, torch.sin))
    along_x = torch.stack([phase_x.cos(), phase_x.sin()], 1).flatten(0, 1) * envelope
    # (cos x + i sin x) (cos y + i sin y), its real part and then its imaginary
    real = torch.stack([phase_y.cos(), -phase_y.sin()], 1)
    imaginary = torch.stack([phase_y.sin(), phase_y.cos()], 1)
    along_y = torch.stack([real, imaginary], 1).flatten(0, 1) * envelope
    reach = len(t) // 2
    wide = pad(plane[None, None], (reach,) * 4, mode="reflect")
    answers = conv2d(conv2d(wide, along_x[:, None, None, :]), along_y[..., None], groups=DIRECTIONS)
    return answers[0].unflatten(0, (DIRECTIONS, 2))


def _blur(planes: Tensor, sigma: float, *, stride: int = 1) -> Tensor:
    height, width = planes.shape[-2:]
    return _smoothing(height, sigma)[::stride].to(planes) @ planes @ _smoothing(width, sigma)[::stride].T.to(planes)


@lru_cache(maxsize=64)
def _smoothing(side: int, sigma: float) -> Tensor:
    """A Gaussian with reflecting borders as a matrix (side, side): a product is far quicker than the convolution."""
    kernel = _gaussian(sigma).double()
    mirrored = pad(torch.eye(side, dtype=torch.float64)[None], (len(kernel) // 2,) * 2, mode="reflect")
    return (mirrored[0].unfold(1, len(kernel), 1) @ kernel).T


def _offsets(sigma: float) -> Tensor:
    reach = ceil(3 * sigma)
    return torch.arange(-reach, reach + 1, dtype=torch.float32)


def _gaussian(sigma: float) -> Tensor:
    weights = torch.exp(-0.5 * (_offsets(sigma) / sigma) ** 2)
    return weights / weights.sum()


@lru_cache
def _directions(dimensions: int) -> Tensor:
    drawn = torch.randn(PROJECTIONS, dimensions, generator=torch.Generator().manual_seed(dimensions))
    return drawn / drawn.norm(dim=1, keepdim=True)


def _quantiles(values: Tensor) -> np.ndarray:
    ordered = np.sort(values.numpy(), axis=1)
    at = np.clip((np.arange(QUANTILES) + 0.5) / QUANTILES * ordered.shape[1] - 0.5, 0, ordered.shape[1] - 1)
    below = at.astype(int)
    above = np.minimum(below + 1, ordered.shape[1] - 1)
    share = (at - below).astype(ordered.dtype)
    return ordered[:, below] * (1 - share) + ordered[:, above] * share


def _apart(levels: list[np.ndarray], others: list[np.ndarray]) -> float:
    return float(np.mean([np.abs(a - b).mean(dtype=float) for a, b in zip(levels, others, strict=True)]))


def _luma(picture: Tensor) -> Tensor:
    # element by element: a dot product may round its last elements differently, and equal pixels would rank apart
    red, green, blue = _checked(picture).double()
    return 0.2126 * red + 0.7152 * green + 0.0722 * blue


def _correlation(a: Tensor, b: Tensor) -> float:
    a, b = a - a.mean(), b - b.mean()
    if min(a.std(), b.std()) < 1e-6:  # flat: what is left is rounding, and would correlate as it pleases
        return 0.0
    return float((a * b).sum() / (a.norm() * b.norm()))


def _resized(picture: Tensor, size: int) -> Tensor:
    light = rgb_to_linear_rgb(picture[None])
    return linear_rgb_to_rgb(interpolate(light, (size, size), mode="bilinear", antialias=True))[0].clamp(0, 1)


def _checked(picture: Tensor) -> Tensor:
    shape = tuple(picture.shape)
    if len(shape) != 3 or shape[0] != 3 or min(shape[1:]) < SMALLEST:
        raise ValueError(f"expected a picture (3, H, W) of at least {SMALLEST} pixels a side, got {shape}")
    return picture.detach().cpu()


def _check_same_size(picture: Tensor, scene: Tensor) -> None:
    if picture.shape != scene.shape:
        raise ValueError(f"the shot {tuple(picture.shape)} must be as large as its scene {tuple(scene.shape)}")
