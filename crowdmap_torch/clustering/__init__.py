"""Clustering of observations and landmarks."""
