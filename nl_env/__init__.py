"""Gymnasium benchmark for adaptive depth sensing with an event camera and a LiDAR."""

__version__ = "0.1.0"
