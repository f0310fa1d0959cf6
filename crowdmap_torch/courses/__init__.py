"""Courses: the common ways of lane markers that many journeys saw, and what follows from them (V-A.2)."""
