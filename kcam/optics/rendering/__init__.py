"""From a scene and a bank of PSFs to the light in each pixel."""
