"""Geometry: poses, cameras, rigs, rays, planes, polygons, curves."""
