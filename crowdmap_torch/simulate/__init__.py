"""Worlds, vehicles and sensors with exact ground truth."""
