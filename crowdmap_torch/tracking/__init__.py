"""Detections of one drive told apart, frame after frame (IV-A)."""
