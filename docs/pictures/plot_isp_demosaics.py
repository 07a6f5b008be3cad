"""
Demosaics compared
==================

Three ways to guess the two colours that each pixel did not see. Bilinear interpolation puts zips and rainbows on fine
edges; methods that use the other colours, or follow the edges, put far fewer.
"""

# %%
# Titles give the PSNR against three full colours in each pixel.

import matplotlib.pyplot as plt

from kcam import Camera, Scene, isp, plots, sensor

scene = Scene.builtin("motorcycle", size=450).crop(top=90, left=200, height=90, width=120)
development = isp.WhiteBalance(), isp.ColourMatrix(), isp.ToneCurve()
full = Camera(sensor.ColourFilter.nikon(), sensor.Exposure(), *development)(scene)[0]
panels = {"three full colours": full}
for method in ("bilinear", "malvar", "menon"):
    camera = Camera(
        sensor.ColourFilter.nikon(), sensor.Mosaic("RGGB"), sensor.Exposure(), isp.Demosaic(method), *development
    )
    picture = camera(scene)[0]
    panels[f"{method}: {-10 * (picture - full).square().mean().log10():.1f} dB"] = picture

fig, axes = plt.subplots(2, 2, figsize=(8, 6.4), layout="constrained")
for ax, (name, picture) in zip(axes.flat, panels.items(), strict=True):
    ax.imshow(plots.as_image(picture), interpolation="nearest")
    ax.set_title(name)
    ax.axis("off")
fig.suptitle("A detail of 120 x 90 pixels through a Bayer mosaic")
plt.show()
