"""Sensor models: event camera and LiDAR."""
