"""Synthetic driving scenes: traffic, world, weather and the renderer."""
