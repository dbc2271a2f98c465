"""Texture look-ups of the shading loops: mip levels and bilinear blending, eight pixels at a time."""

from __future__ import annotations

import numpy as np
from numba import njit

from nl_env.lanes import EXACT, fused, gather, splat, to_float, to_int, where
from nl_env.scene.raster import INLINE, i4

LONG_RUN = 16
"""Pixels from which on the whole groups of eight of a textured run take the quick reciprocal."""


@njit(**EXACT)
def bilinear(texels, a, b):
    """Blend the four neighbours packed in each texel; ``a`` and ``b`` are the fractions along x and y."""
    byte = splat(255)
    t00 = texels & byte
    t10 = (texels >> splat(16)) & byte
    top = fused(to_float(((texels >> splat(8)) & byte) - t00), a, to_float(t00))
    bottom = fused(to_float((texels >> splat(24)) - t10), a, to_float(t10))
    return fused(bottom - top, b, top)


@njit(**EXACT)
def floor(x):
    """Largest integers not above ``x``."""
    towards_zero = to_int(x)
    below = where(x < to_float(towards_zero), splat(1), splat(0))
    return towards_zero - below


@njit(**EXACT)
def repeating(texels, offset, bits, u, v, iu, iv, wanted):
    """Blend the texels at ``(u, v)``, in texels, of a texture level of side ``1 << bits``."""
    inside = splat((i4(1) << bits) - i4(1))
    at = splat(offset) + (((iv & inside) << splat(bits)) | (iu & inside))
    return bilinear(gather(texels, at, wanted), u - to_float(iu), v - to_float(iv))


@njit(**INLINE)
def mip_level(texels, levels):
    """Mip level at which ``texels`` per pixel become at most one and a half: how often to halve them."""
    # A halving takes one off the exponent, which starts at bit 52.
    halvings = (np.float64(texels).view(np.int64) - np.float64(1.5).view(np.int64) + (1 << 52) - 1) >> 52
    return min(max(halvings, 0), levels - 1)
