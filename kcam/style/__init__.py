"""Cameras that learn the style of a picture."""
