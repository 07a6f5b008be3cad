"""What a texture is measured by, and pictures that are moved until they have it."""
