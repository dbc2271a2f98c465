"""Depth metrics, baselines and extrapolators."""
