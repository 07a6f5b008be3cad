"""
Four mosaics
============

Above the raw signals, each pixel in the colour of its filter: Bayer's tile, the same with four pixels for each filter,
X-Trans, and one with white pixels for the dark. Below the pictures that are made of them.
"""

# %%
# ``plots.mosaic_tile`` knows the colours of a camera's mosaic, ``plots.false_colour`` paints a raw signal with them.

import matplotlib.pyplot as plt

from kcam import Camera, Scene, isp, plots, sensor

scene = Scene.builtin("chelsea", size=300).crop(top=60, left=80, height=72, width=72)
mosaics = {
    "Bayer": (sensor.ColourFilter.nikon(), "RGGB"),
    "quad Bayer": (sensor.ColourFilter.nikon(), "quad_bayer"),
    "X-Trans": (sensor.ColourFilter.nikon(), "x_trans"),
    "RGBW": (sensor.ColourFilter.rgbw(), "rgbw"),
}
fig, axes = plt.subplots(2, 4, figsize=(9, 4.9), layout="constrained")
for column, (name, (colour_filter, pattern)) in zip(axes.T, mosaics.items(), strict=True):
    camera = Camera(
        colour_filter, sensor.Mosaic(pattern), sensor.Exposure(),
        isp.Demosaic(), isp.WhiteBalance(), isp.ColourMatrix(), isp.ToneCurve(),
    )  # fmt: skip
    column[0].imshow(plots.false_colour(camera.raw(scene)[0], plots.mosaic_tile(camera))[20:52, 20:52])
    column[1].imshow(plots.as_image(camera(scene)[0]))
    column[0].set_title(name)
    for ax in column:
        ax.axis("off")
fig.suptitle("Raw signals of 32 pixels, and demosaiced pictures of 72")
plt.show()
