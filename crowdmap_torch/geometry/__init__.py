"""Maths on tensors: poses, cameras, rigs, rays, planes, polygons, splines, ways."""
