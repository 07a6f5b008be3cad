"""Cameras that learn a painting's style."""
