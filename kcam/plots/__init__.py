"""Figures of pictures and PSFs, and pictures as files."""

from kcam.plots.comparison import compare
from kcam.plots.contact_sheet import contact_sheet
from kcam.plots.lens import field_figure, lens_figure, lens_text, opd_figure, section_figure, spot_figure
from kcam.plots.pictures import (
    CHANNEL_COLOURS,
    PICTURE_SUFFIXES,
    as_image,
    check_writable,
    false_colour,
    light_colours,
    mosaic_tile,
    write_picture,
)
from kcam.plots.psf import (
    CURVE_COLOURS,
    SHARE_SHOWN,
    centre,
    distance_colours,
    optics_text,
    psf_figure,
    psf_image,
    reach_of,
)
from kcam.plots.sheet import (
    FAINT,
    FIGURE_SUFFIXES,
    INK,
    LABEL,
    MUTED,
    SMALL,
    TITLE,
    Sheet,
    duration,
    figure_bytes,
    metres,
    percent_or_more,
    quiet,
    save_figure,
    shortened,
)
from kcam.plots.stages import Step, pipeline, pipeline_figure, steps
from kcam.plots.tradeoff import KNOB_COLOURS, tradeoff_figure

__all__ = [
    "CHANNEL_COLOURS", "CURVE_COLOURS", "FAINT", "FIGURE_SUFFIXES", "INK", "KNOB_COLOURS", "LABEL", "MUTED",
    "PICTURE_SUFFIXES", "SHARE_SHOWN", "SMALL", "TITLE", "Sheet", "Step", "as_image", "centre", "check_writable",
    "compare", "contact_sheet", "distance_colours", "duration", "false_colour", "field_figure", "figure_bytes",
    "lens_figure", "lens_text", "light_colours", "metres", "mosaic_tile", "opd_figure",
    "optics_text", "percent_or_more", "pipeline", "pipeline_figure", "psf_figure", "psf_image", "quiet", "reach_of",
    "save_figure",
    "section_figure", "shortened", "spot_figure", "steps", "tradeoff_figure", "write_picture",
]  # fmt: skip
