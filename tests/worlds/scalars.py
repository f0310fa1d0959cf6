"""Vectors and matrices as lists of Python numbers: for formulas that are to be read beside those of the paper."""

from __future__ import annotations

import math

Vector = list[float]
Matrix = list[Vector]


def dot(a: Vector, b: Vector) -> float:
    return sum(x * y for x, y in zip(a, b, strict=True))


def times(A: Matrix, b: Vector) -> Vector:
    return [dot(row, b) for row in A]


def product(A: Matrix, B: Matrix) -> Matrix:
    return [times(transposed(B), row) for row in A]


def transposed(A: Matrix) -> Matrix:
    return [list(column) for column in zip(*A, strict=True)]


def minus(a: Vector, b: Vector) -> Vector:
    return [x - y for x, y in zip(a, b, strict=True)]


def plus(a: Vector, b: Vector, factor: float = 1.0) -> Vector:
    return [x + factor * y for x, y in zip(a, b, strict=True)]


def norm(a: Vector) -> float:
    return math.sqrt(dot(a, a))


def mean(vectors: list[Vector]) -> Vector:
    return [sum(column) / len(vectors) for column in zip(*vectors, strict=True)]


def cross_matrix(a: Vector) -> Matrix:
    return [[0.0, -a[2], a[1]], [a[2], 0.0, -a[0]], [-a[1], a[0], 0.0]]


def rotation_and_place(T: Matrix) -> tuple[Matrix, Vector]:
    """R and c of a pose, camera to world."""
    return [row[:3] for row in T[:3]], [row[3] for row in T[:3]]


def seen_from(T_world_camera: Matrix, point: Vector) -> Vector:
    """A world point in the camera's frame."""
    R, c = rotation_and_place(T_world_camera)
    return times(transposed(R), minus(point, c))


def pinhole(point_camera: Vector, K: Matrix) -> Vector:
    """The pixel of a point in front of a camera without distortion."""
    x, y, z = point_camera
    return [K[0][0] * x / z + K[0][2], K[1][1] * y / z + K[1][2]]


def smallest_eigenvalue(S: Matrix) -> float:
    """Of a symmetric 3 x 3 matrix, by the trigonometric solution of its characteristic polynomial."""
    q = (S[0][0] + S[1][1] + S[2][2]) / 3
    off = S[0][1] ** 2 + S[0][2] ** 2 + S[1][2] ** 2
    p = math.sqrt((sum((S[i][i] - q) ** 2 for i in range(3)) + 2 * off) / 6)
    B = [[(S[i][j] - (q if i == j else 0.0)) / p for j in range(3)] for i in range(3)]
    det = dot(B[0], times(cross_matrix(B[1]), B[2]))
    return q + 2 * p * math.cos(math.acos(max(-1.0, min(1.0, det / 2))) / 3 + 2 * math.pi / 3)


def natural_spline(values: Vector, t: float) -> float:
    """The natural cubic spline through values at 0, 1, 2, ...: second derivatives from the tridiagonal system."""
    n = len(values)
    diagonal, right = [1.0] + [4.0] * (n - 2) + [1.0], [0.0] * n
    for k in range(1, n - 1):
        right[k] = 6 * (values[k - 1] - 2 * values[k] + values[k + 1])
    for k in range(2, n - 1):
        diagonal[k] -= 1 / diagonal[k - 1]
        right[k] -= right[k - 1] / diagonal[k - 1]
    second = [0.0] * n
    for k in range(n - 2, 0, -1):
        second[k] = (right[k] - second[k + 1]) / diagonal[k]
    k = min(int(t), n - 2)
    b, a = t - k, 1 - (t - k)
    bent = (a**3 - a) * second[k] + (b**3 - b) * second[k + 1]
    return a * values[k] + b * values[k + 1] + bent / 6


def tukey(s: float, c: float) -> float:
    """Tukey's biweight loss of a squared length (Zhang 1997)."""
    if s > c * c:
        return c * c / 3
    return c * c / 3 * (1 - (1 - s / (c * c)) ** 3)
