"""The colour filter array: which channel each pixel records."""

from __future__ import annotations

import torch
from torch import Tensor

from kcam.context import Context, Stage
from kcam.inputs import check_signal, remedy

CHANNELS = "RGBW"


def _tile(*rows: str) -> tuple[tuple[int, ...], ...]:
    return tuple(tuple(CHANNELS.index(letter) for letter in row) for row in rows)


# One tile per pattern, as channel indices (R=0, G=1, B=2, W=3); its top left corner lies on the picture's.
# A new pattern is a new row. Sources: Bayer, US 3 971 065; X-Trans as in LibRaw's table (US 8 531 563);
# rgbw is Kodak's "Sparse" array of Compton and Hamilton, US 8 139 130.
PATTERNS: dict[str, tuple[tuple[int, ...], ...]] = {
    "RGGB": _tile("RG", "GB"),
    "GRBG": _tile("GR", "BG"),
    "GBRG": _tile("GB", "RG"),
    "BGGR": _tile("BG", "GR"),
    "quad_bayer": _tile("RRGG", "RRGG", "GGBB", "GGBB"),
    "x_trans": _tile("GGRGGB", "GGBGGR", "BRGRBG", "GGBGGR", "GGRGGB", "RBGBRG"),
    "rgbw": _tile("WBWG", "BWGW", "WGWR", "GWRW"),
}
"""Name of a colour filter array -> its tile: rows of channels, 0 red, 1 green, 2 blue, 3 white."""


def pattern_tile(pattern: str) -> Tensor:
    """The repeating tile of a pattern as channel indices, (rows, columns) int64; ValueError for an unknown name."""
    if pattern not in PATTERNS:
        raise ValueError(f"pattern {pattern!r} is unknown; expected one of {', '.join(PATTERNS)}.")
    return torch.tensor(PATTERNS[pattern])


def channel_masks(pattern: str, height: int, width: int, *, device: torch.device | str | None = None) -> Tensor:
    """Where each channel is recorded: one mask per channel of the pattern (3, or 4 with white).

    Args:      pattern: a name in `PATTERNS`.  height, width: of the picture, >= 0 pixels, odd ones too.
    Returns:   (C, height, width) bool; at every pixel exactly one channel is True.
    Raises:    ValueError for an unknown pattern.

    Example:
    >>> sensor.channel_masks("RGGB", 4, 4).sum((1, 2)).tolist()  # green twice
    [4, 8, 4]
    """
    tile = pattern_tile(pattern).to(device)
    channels = int(tile.max()) + 1
    one_hot = tile == torch.arange(channels, device=tile.device)[:, None, None]
    rows, columns = tile.shape
    return one_hot.repeat(1, -(-height // rows), -(-width // columns))[:, :height, :width]


def at_pixels(values: Tensor | float, signal: Tensor, *, pattern: str, name: str) -> Tensor:
    """What belongs to a channel, at each pixel that records it: (C,1,1) of full planes, (1,H,W) of a mosaic.

    Args:      values: a number for all, or one for each channel (C,).  signal: (..., C, H, W), or (..., 1, H, W) behind
               a mosaic.  pattern: its name.  name: of the values, for the error.
    Raises:    ValueError for another number of values.
    """
    dtype = values.dtype if isinstance(values, Tensor) else torch.float64
    found = torch.as_tensor(values, dtype=dtype, device=signal.device).flatten()
    planes, height, width = signal.shape[-3:]
    if len(found) in (1, planes):
        return found[:, None, None]
    tile = pattern_tile(pattern).to(found.device)
    if planes == 1 and len(found) == int(tile.max()) + 1:
        rows, columns = (-(-n // m) for n, m in zip((height, width), tile.shape, strict=True))
        return found[tile].repeat(1, rows, columns)[:, :height, :width]
    of_pattern = f", or {int(tile.max()) + 1} of the pattern {pattern!r}" if planes == 1 else ""
    raise ValueError(
        f"{name} has {len(found)} values for {planes} channels. Give one number for all, or {planes}{of_pattern}."
    )


def mosaic(signal: Tensor, *, pattern: str) -> Tensor:
    """Keep at each pixel the one channel that the colour filter array lets through.

    raw(y, x) = signal(channel(y mod rows, x mod columns), y, x)

    Args:      signal: (..., C, H, W), C = 3, or 4 for "rgbw".  pattern: a name in `PATTERNS`.
    Returns:   (..., 1, H, W), values unchanged; the gradient is 1 at the kept channel, 0 elsewhere.
    Raises:    ValueError for an unknown pattern or another number of channels; TypeError for integers.

    Example:
    >>> channels = torch.arange(3.0)[:, None, None].expand(3, 2, 4)  # red 0, green 1, blue 2
    >>> sensor.mosaic(channels, pattern="GBRG").tolist()
    [[[1.0, 2.0, 1.0, 2.0], [0.0, 1.0, 0.0, 1.0]]]
    """
    check_signal(signal)
    tile = pattern_tile(pattern)
    channels = int(tile.max()) + 1
    if signal.ndim < 3 or signal.shape[-3] != channels:
        raise ValueError(
            f"pattern {pattern!r} selects among {channels} channels ({', '.join(CHANNELS[:channels])}): expected "
            f"(..., {channels}, H, W), got shape {tuple(signal.shape)}. Put a ColourFilter with {channels} curves "
            "before it; a learned tile gives the mosaiced plane itself and takes no Mosaic."
            f"{remedy(signal, name='signal', channels=(channels,), scaled=False)}"
        )
    masks = channel_masks(pattern, *signal.shape[-2:], device=signal.device)
    raw = signal[..., 0, :, :]
    for channel in range(1, channels):  # a selection, not a sum of products: an inf in one channel stays there
        raw = torch.where(masks[channel], signal[..., channel, :, :], raw)
    return raw.unsqueeze(-3)


class Mosaic(Stage):
    """The colour filter array as a stage: `mosaic` with a named pattern. Any height and width, odd ones too.

    Example:
    >>> channels = torch.arange(3.0)[None, :, None, None].expand(1, 3, 4, 4)  # red 0, green 1, blue 2
    >>> sensor.Mosaic("RGGB")(channels)[0, 0, :2].tolist()
    [[0.0, 1.0, 0.0, 1.0], [1.0, 2.0, 1.0, 2.0]]
    """

    def __init__(self, pattern: str = "RGGB"):
        super().__init__()
        pattern_tile(pattern)
        self.pattern = pattern

    def forward(self, signal: Tensor, context: Context | None = None) -> Tensor:
        """(B,C,H,W) to (B,1,H,W): see `mosaic`."""
        return mosaic(signal, pattern=self.pattern)

    def output_channels(self, channels: int, context: Context | None = None) -> int:
        """One plane."""
        return 1

    def provides(self) -> dict[str, str]:
        """The pattern, for the demosaic."""
        return {"pattern": self.pattern}

    def extra_repr(self) -> str:
        """The pattern's name."""
        return repr(self.pattern)
