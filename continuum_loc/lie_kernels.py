"""
SE(3) for compiled loops: one element at a time, results written into the caller's arrays.

The conventions are those of `continuum_loc.lie`, which is the oracle of these functions in the
tests. Beyond it, `polynomial_times` gives the exact derivative of J(xi) w by xi, which the
Gaussian-process factors and the interpolation need. Arrays are float64 and C-contiguous; no
function allocates: they work in records of TWIST and SCRATCH that the caller owns.

Everything that the adjoint generates has the form [[X, Y], [0, X]], so that a product of two costs
three 3x3 products; `block_product` uses that.
"""

from __future__ import annotations

import math

from continuum_loc.compiling import kernel
from continuum_loc.lie import INVERSE_SERIES, LEFT_SERIES, SMALL_ANGLE
import numpy as np

# A twist x and a power series of its adjoint, f(ad(x)) = sum c_i ad(x)^i.
TWIST = np.dtype(
    [
        ('x', float, 6),
        ('ad', float, (6, 6)),  # its adjoint matrix
        ('c', float, 5),  # the coefficients
        ('dc', float, 5),  # their derivatives by the angle phi, over phi
    ]
)
# Room for what is of no use after a function returns.
SCRATCH = np.dtype(
    [
        ('pose', float, (4, 4)),
        ('matrix', float, (6, 6)),
        ('blocks', float, (2, 6, 6)),
        ('powers', float, (5, 6)),
    ]
)


@kernel(inline='always')
def _hat_into(out, row, column, x, y, z):
    """Write the skew matrix of (x, y, z) into the 3x3 block of `out` at (row, column)."""
    out[row, column] = 0.0
    out[row, column + 1] = -z
    out[row, column + 2] = y
    out[row + 1, column] = z
    out[row + 1, column + 1] = 0.0
    out[row + 1, column + 2] = -x
    out[row + 2, column] = -y
    out[row + 2, column + 1] = x
    out[row + 2, column + 2] = 0.0


@kernel
def ad(x, out):
    """Adjoint matrix of x (6,) in se(3), into out (6, 6)."""
    _hat_into(out, 0, 0, x[3], x[4], x[5])
    _hat_into(out, 3, 3, x[3], x[4], x[5])
    _hat_into(out, 0, 3, x[0], x[1], x[2])
    for i in range(3):
        for j in range(3):
            out[3 + i, j] = 0.0


@kernel
def bracket(x, y, out):
    """Out (6,) = ad(x) y."""
    out[0] = x[4] * y[2] - x[5] * y[1] + x[1] * y[5] - x[2] * y[4]
    out[1] = x[5] * y[0] - x[3] * y[2] + x[2] * y[3] - x[0] * y[5]
    out[2] = x[3] * y[1] - x[4] * y[0] + x[0] * y[4] - x[1] * y[3]
    out[3] = x[4] * y[5] - x[5] * y[4]
    out[4] = x[5] * y[3] - x[3] * y[5]
    out[5] = x[3] * y[4] - x[4] * y[3]


@kernel
def block_product(A, B, out):
    """Out = A B for matrices of the form [[X, Y], [0, X]]."""
    for i in range(3):
        for j in range(3):
            x = 0.0
            y = 0.0
            for k in range(3):
                x += A[i, k] * B[k, j]
                y += A[i, k] * B[k, j + 3] + A[i, k + 3] * B[k, j]
            out[i, j] = x
            out[i + 3, j + 3] = x
            out[i, j + 3] = y
            out[i + 3, j] = 0.0


@kernel
def product(A, B, out):
    """Out (6, 6) = A B."""
    for i in range(6):
        for j in range(6):
            out[i, j] = 0.0
        for k in range(6):  # the innermost loop is over neighbours in memory
            scale = A[i, k]
            for j in range(6):
                out[i, j] += scale * B[k, j]


@kernel
def apply(A, x, out):
    """Out (6,) = A x."""
    for i in range(6):
        total = 0.0
        for k in range(6):
            total += A[i, k] * x[k]
        out[i] = total


@kernel
def exp(x, T):
    """Exponential of x, into T (4, 4)."""
    a, b, c = x[3], x[4], x[5]
    square = a * a + b * b + c * c
    angle = math.sqrt(square)
    if angle < 1e-2:
        sinc = 1.0 - square / 6.0 + square * square / 120.0
        half = 0.5 - square / 24.0 + square * square / 720.0
        third = 1.0 / 6.0 - square / 120.0 + square * square / 5040.0
    else:
        sinc = math.sin(angle) / angle
        half = 2.0 * math.sin(0.5 * angle) ** 2 / square
        third = (angle - math.sin(angle)) / (square * angle)
    T[0, 0] = 1.0 - half * (b * b + c * c)
    T[1, 1] = 1.0 - half * (a * a + c * c)
    T[2, 2] = 1.0 - half * (a * a + b * b)
    T[0, 1] = half * a * b - sinc * c
    T[1, 0] = half * a * b + sinc * c
    T[0, 2] = half * a * c + sinc * b
    T[2, 0] = half * a * c - sinc * b
    T[1, 2] = half * b * c - sinc * a
    T[2, 1] = half * b * c + sinc * a
    # p = rho + half phi x rho + third phi x (phi x rho)
    u, v, w = x[0], x[1], x[2]
    cu, cv, cw = b * w - c * v, c * u - a * w, a * v - b * u
    T[0, 3] = u + half * cu + third * (b * cw - c * cv)
    T[1, 3] = v + half * cv + third * (c * cu - a * cw)
    T[2, 3] = w + half * cw + third * (a * cv - b * cu)
    T[3, 0] = T[3, 1] = T[3, 2] = 0.0
    T[3, 3] = 1.0


@kernel
def log(T, x):
    """
    Logarithm of T, into x (6,), angle in [0, pi].

    Through the quaternion whose largest component divides.
    """
    xx, yy, zz = T[0, 0], T[1, 1], T[2, 2]
    a, b, c = T[2, 1] - T[1, 2], T[0, 2] - T[2, 0], T[1, 0] - T[0, 1]
    trace = xx + yy + zz
    if trace >= xx and trace >= yy and trace >= zz:
        w, qx, qy, qz = 1.0 + trace, a, b, c
    elif xx >= yy and xx >= zz:
        w, qx, qy, qz = a, 1.0 + xx - yy - zz, T[0, 1] + T[1, 0], T[0, 2] + T[2, 0]
    elif yy >= zz:
        w, qx, qy, qz = b, T[0, 1] + T[1, 0], 1.0 - xx + yy - zz, T[1, 2] + T[2, 1]
    else:
        w, qx, qy, qz = c, T[0, 2] + T[2, 0], T[1, 2] + T[2, 1], 1.0 - xx - yy + zz
    if w < 0.0:
        w, qx, qy, qz = -w, -qx, -qy, -qz
    norm = math.sqrt(qx * qx + qy * qy + qz * qz)
    angle = 2.0 * math.atan2(norm, w)
    scale = angle / norm if norm > 1e-150 else 2.0 / w
    f, g, h = scale * qx, scale * qy, scale * qz
    # rho = p - phi x p / 2 + (1 - (phi/2) cot(phi/2)) / phi^2  phi x (phi x p)
    square = f * f + g * g + h * h
    if angle < 1e-2:
        k = 1.0 / 12.0 + square / 720.0 + square * square / 30240.0
    else:
        k = (1.0 - 0.5 * angle / math.tan(0.5 * angle)) / square
    u, v, p = T[0, 3], T[1, 3], T[2, 3]
    cu, cv, cw = g * p - h * v, h * u - f * p, f * v - g * u
    x[0] = u - 0.5 * cu + k * (g * cw - h * cv)
    x[1] = v - 0.5 * cv + k * (h * cu - f * cw)
    x[2] = p - 0.5 * cw + k * (f * cv - g * cu)
    x[3] = f
    x[4] = g
    x[5] = h


@kernel
def relative(Ta, Tb, out):
    """Out (4, 4) = Ta^-1 Tb."""
    for i in range(3):
        for j in range(3):
            out[i, j] = Ta[0, i] * Tb[0, j] + Ta[1, i] * Tb[1, j] + Ta[2, i] * Tb[2, j]
        out[i, 3] = (
            Ta[0, i] * (Tb[0, 3] - Ta[0, 3])
            + Ta[1, i] * (Tb[1, 3] - Ta[1, 3])
            + Ta[2, i] * (Tb[2, 3] - Ta[2, 3])
        )
        out[3, i] = 0.0
    out[3, 3] = 1.0


@kernel
def compose(Ta, Tb, out):
    """Out (4, 4) = Ta Tb; `out` must not be one of them."""
    for i in range(3):
        for j in range(3):
            out[i, j] = Ta[i, 0] * Tb[0, j] + Ta[i, 1] * Tb[1, j] + Ta[i, 2] * Tb[2, j]
        out[i, 3] = Ta[i, 0] * Tb[0, 3] + Ta[i, 1] * Tb[1, 3] + Ta[i, 2] * Tb[2, 3] + Ta[i, 3]
        out[3, i] = 0.0
    out[3, 3] = 1.0


@kernel
def adjoint(T, out):
    """Out (6, 6) = Ad(T)."""
    for j in range(3):
        for i in range(3):
            out[i, j] = T[i, j]
            out[i + 3, j + 3] = T[i, j]
            out[i + 3, j] = 0.0
        out[0, j + 3] = T[1, 3] * T[2, j] - T[2, 3] * T[1, j]
        out[1, j + 3] = T[2, 3] * T[0, j] - T[0, 3] * T[2, j]
        out[2, j + 3] = T[0, 3] * T[1, j] - T[1, 3] * T[0, j]


@kernel
def _taylor(series, square, value, slope):
    """Value of the Taylor polynomials in phi^2 and their derivative by phi, divided by phi."""
    for row in range(series.shape[0]):
        total = 0.0
        derivative = 0.0
        for k in range(series.shape[1] - 1, -1, -1):
            derivative = derivative * square + total
            total = total * square + series[row, k]
        value[row] = total
        slope[row] = 2.0 * derivative


@kernel
def right_coefficients(x, c, dc):
    """Write c (5,) and dc (5,) of J_r(x) = sum c_i ad(x)^i, as TWIST has them."""
    square = x[3] * x[3] + x[4] * x[4] + x[5] * x[5]
    f = math.sqrt(square)
    c[0] = 1.0
    dc[0] = 0.0
    if f < SMALL_ANGLE:
        _taylor(LEFT_SERIES, square, c[1:], dc[1:])
    else:
        s, k = math.sin(f), math.cos(f)
        f2, f3 = square, square * f
        c[1] = (4.0 - f * s - 4.0 * k) / (2.0 * f2)
        c[2] = (4.0 * f - 5.0 * s + f * k) / (2.0 * f3)
        c[3] = (2.0 - f * s - 2.0 * k) / (2.0 * f2 * f2)
        c[4] = (2.0 * f - 3.0 * s + f * k) / (2.0 * f2 * f3)
        dc[1] = ((3.0 * s - f * k) / (2.0 * f2) - 2.0 * c[1] / f) / f
        dc[2] = ((4.0 - 4.0 * k - f * s) / (2.0 * f3) - 3.0 * c[2] / f) / f
        dc[3] = ((s - f * k) / (2.0 * f2 * f2) - 4.0 * c[3] / f) / f
        dc[4] = ((2.0 - 2.0 * k - f * s) / (2.0 * f2 * f3) - 5.0 * c[4] / f) / f
    c[1], c[3], dc[1], dc[3] = -c[1], -c[3], -dc[1], -dc[3]


@kernel
def right_inverse_coefficients(x, c, dc):
    """Do as `right_coefficients` for J_r(x)^-1 = sum c_i ad(x)^i."""
    square = x[3] * x[3] + x[4] * x[4] + x[5] * x[5]
    f = math.sqrt(square)
    c[0], c[1], c[3] = 1.0, 0.5, 0.0
    dc[0], dc[1], dc[3] = 0.0, 0.0, 0.0
    if f < SMALL_ANGLE:
        _taylor(INVERSE_SERIES, square, c[2::2], dc[2::2])
    else:
        half = 0.5 * f
        h = half / math.tan(half)
        p = (half / math.sin(half)) ** 2
        slope = 0.5 * (h - p)  # phi h' / 2
        dh = 2.0 * slope / f
        dslope = 0.5 * (dh - 2.0 * p * (1.0 - h) / f)
        c[2] = (2.0 * (1.0 - h) + slope) / square
        c[4] = (slope - h + 1.0) / (square * square)
        dc[2] = ((-2.0 * dh + dslope) / square - 2.0 * c[2] / f) / f
        dc[4] = ((dslope - dh) / (square * square) - 4.0 * c[4] / f) / f


@kernel
def polynomial(c, A, out, work):
    """
    Out = sum c_i A^i for A of the form [[X, Y], [0, X]]; work (2, 6, 6).

    As c0 I + c1 A + (c2 I + c3 A + c4 A^2) A^2 it takes two products.
    """
    square, outer = work[0], work[1]
    block_product(A, A, square)
    for i in range(6):
        for j in range(6):
            outer[i, j] = c[3] * A[i, j] + c[4] * square[i, j]
        outer[i, i] += c[2]
    block_product(outer, square, out)
    for i in range(6):
        for j in range(6):
            out[i, j] += c[1] * A[i, j]
        out[i, i] += c[0]


@kernel
def polynomial_times(twist, w, value, derivative, scratch):
    """
    Write f(ad(x)) w into value (6,), and its derivative by x into derivative (6, 6).

    f is the series of `twist`, a TWIST. With w_i = ad(x)^i w: d(w_i)/dx = D_i, D_1 = -ad(w),
    D_{i+1} = ad(x) D_i - ad(w_i); the coefficients themselves add sum (c_i'/phi) w_i [0; phi]^T.
    """
    x, c, dc, vectors = twist.x, twist.c, twist.dc, scratch.powers
    for i in range(6):
        vectors[0, i] = w[i]
    for k in range(1, 5):
        bracket(x, vectors[k - 1], vectors[k])
    D, following = scratch.blocks[0], scratch.blocks[1]
    for i in range(6):
        for j in range(6):
            derivative[i, j] = following[i, j] = 0.0
    for k in range(1, 5):
        if k > 1:
            block_product(twist.ad, D, following)
        for i in range(6):
            for j in range(6):
                D[i, j] = following[i, j]
        _subtract_ad(D, vectors[k - 1])
        if c[k] != 0.0:
            for i in range(6):
                for j in range(6):
                    derivative[i, j] += c[k] * D[i, j]
    for i in range(6):
        value[i] = 0.0
        rank_one = 0.0
        for k in range(5):
            value[i] += c[k] * vectors[k, i]
            rank_one += dc[k] * vectors[k, i]
        for j in range(3, 6):
            derivative[i, j] += rank_one * x[j]


@kernel
def _subtract_ad(D, x):
    """D -= ad(x)."""
    for offset in (0, 3):
        D[offset, offset + 1] += x[5]
        D[offset, offset + 2] -= x[4]
        D[offset + 1, offset] -= x[5]
        D[offset + 1, offset + 2] += x[3]
        D[offset + 2, offset] += x[4]
        D[offset + 2, offset + 1] -= x[3]
    D[0, 4] += x[2]
    D[0, 5] -= x[1]
    D[1, 3] -= x[2]
    D[1, 5] += x[0]
    D[2, 3] += x[1]
    D[2, 4] -= x[0]


@kernel
def pose_error(T_wanted, T, error, J, scratch):
    """Write Log(T_wanted^-1 T) into `error`, a TWIST, and its Jacobian by T into J (6, 6)."""
    relative(T_wanted, T, scratch.pose)
    log(scratch.pose, error.x)
    ad(error.x, error.ad)
    right_inverse_coefficients(error.x, error.c, error.dc)
    polynomial(error.c, error.ad, J, scratch.blocks)
