"""Real lenses: surfaces with a common axis, traced exactly, and their PSFs over the whole field."""
