"""Crowd-sourced maps of traffic signs and lane markings from many noisy journeys."""

__version__ = "0.1.0"
