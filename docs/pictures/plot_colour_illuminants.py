"""
One cup in four lights
======================

Coffee in daylight, in the light of a bulb, of a fluorescent tube and of an LED. Above the camera is balanced for
daylight and shows the colour of each light; below it is balanced for the light at hand, and the cup looks nearly alike.
"""

# %%
# Nearly, for a camera sees three numbers: what a line spectrum leaves out no balance brings back.

import matplotlib.pyplot as plt
import torch

from kcam import Camera, Scene, isp, plots, sensor, spectral
from kcam.units import nm

lights = {"daylight, D65": "D65", "bulb, A": "A", "tube, FL2": "FL2", "LED, LED-B1": "LED-B1"}
wavelengths = torch.linspace(400, 720, 65) * nm
colour_filter = sensor.ColourFilter.nikon()
white = colour_filter.white(wavelengths, illuminant=spectral.illuminant("D65", wavelengths=wavelengths))
for_daylight = isp.WhiteBalance(white[1] / white)

fig, axes = plt.subplots(3, 4, figsize=(9, 5.6), layout="constrained", height_ratios=[1.2, 2, 2])
for column, (name, light) in zip(axes.T, lights.items(), strict=True):
    scene = Scene.builtin("coffee", size=220, wavelengths=wavelengths, illuminant=light)
    column[0].fill_between(wavelengths / nm, spectral.illuminant(light, wavelengths=wavelengths), color="0.6")
    column[0].set(title=name, yticks=[], xlabel="wavelength [nm]")
    for ax, balance in zip(column[1:], (for_daylight, isp.WhiteBalance()), strict=True):
        camera = Camera(colour_filter, sensor.Exposure(0.6), balance, isp.ColourMatrix(), isp.ToneCurve())
        ax.imshow(plots.as_image(camera(scene)[0]))
        ax.axis("off")
fig.suptitle("Four lights: spectrum, picture balanced for daylight, picture balanced for the light")
plt.show()
