"""Random numbers by counting: the numbers of photon n depend on the key and on n alone.

Philox 4x32 with ten rounds (Salmon et al. 2011, SC '11, doi:10.1145/2063384.2063405)
turns a key and a counter into four words of 32 bits.  Nothing is carried from one photon
to the next, so any number of threads and any chunking of the photons give the same bits.
Logarithm, sine and cosine are polynomials in single precision (minimax, as in Cephes'
logf, sinf and cosf), which compile to vector code; their error is below 2e-7.
"""

import numba
import numpy as np

from bfsensor._kernels.compile_options import INLINED, INNER
from bfsensor._kernels.extremes import min


@numba.njit(**INLINED)
def philox(c0, c1, c2, c3, k0, k1):
    """Four random words from a counter of four and a key of two (all uint32)."""
    # In words of 64 bits, of which the upper halves are cut off where they would count: vector code
    # multiplies the lower halves of such words, and has nothing to repack.
    low = np.uint64(0xFFFFFFFF)
    c0, c1, c2, c3 = np.uint64(c0), np.uint64(c1), np.uint64(c2), np.uint64(c3)
    k0, k1 = np.uint64(k0), np.uint64(k1)
    for _ in range(10):
        p0 = np.uint64(0xD2511F53) * (c0 & low)
        p1 = np.uint64(0xCD9E8D57) * (c2 & low)
        c0 = (p1 >> np.uint64(32)) ^ c1 ^ k0
        c2 = (p0 >> np.uint64(32)) ^ c3 ^ k1
        c1 = p1
        c3 = p0
        k0 = (k0 + np.uint64(0x9E3779B9)) & low
        k1 = (k1 + np.uint64(0xBB67AE85)) & low
    return (
        np.uint32(c0 & low),
        np.uint32(c1 & low),
        np.uint32(c2 & low),
        np.uint32(c3 & low),
    )


@numba.njit(**INLINED)
def log_single(x):
    """Natural logarithm of a positive float32."""
    bits = np.float32(x).view(np.int32)
    # The mantissa is taken to lie from sqrt(1/2) to sqrt(2).
    exponent = np.int32(np.int32(bits - np.int32(0x3F3504F3)) >> np.int32(23))
    m = np.int32(bits - np.int32(exponent << np.int32(23))).view(np.float32) - np.float32(1)
    p = np.float32(7.0376836292e-2)
    p = p * m + np.float32(-1.1514610310e-1)
    p = p * m + np.float32(1.1676998740e-1)
    p = p * m + np.float32(-1.2420140846e-1)
    p = p * m + np.float32(1.4249322787e-1)
    p = p * m + np.float32(-1.6668057665e-1)
    p = p * m + np.float32(2.0000714765e-1)
    p = p * m + np.float32(-2.4999993993e-1)
    p = p * m + np.float32(3.3333331174e-1)
    z = m * m
    y = m * z * p - np.float32(0.5) * z + m
    return np.float32(y + np.float32(exponent) * np.float32(0.69314718056))


@numba.njit(**INLINED)
def log_uniform(word):
    """Logarithm of the uniform deviate (word + 1/2) / 2^32, a float32 below zero."""
    # The scale is a power of two; a word that rounds to 2^32 would give 0.
    x = (np.float32(word) + np.float32(0.5)) * np.float32(2.3283064e-10)
    return min(log_single(x), np.float32(-5.9604645e-8))


@numba.njit(**INLINED)
def sine_cosine(word):
    """Sine and cosine of the angle 2 pi word / 2^32, float32."""
    shifted = (np.uint64(word) + np.uint64(0x20000000)) & np.uint64(0xFFFFFFFF)
    quarter = np.int32(shifted >> np.uint64(30))
    rest = np.int32(np.int64(shifted & np.uint64(0x3FFFFFFF)) - np.int64(0x20000000))
    r = np.float32(rest) * np.float32(1.4629180792671596e-09)  # 2 pi / 2^32
    z = r * r
    s = np.float32(-1.9515295891e-4)
    s = (s * z + np.float32(8.3321608736e-3)) * z + np.float32(-1.6666654611e-1)
    s = s * z * r + r
    c = np.float32(2.443315711809948e-5)
    c = (c * z + np.float32(-1.388731625493765e-3)) * z + np.float32(4.166664568298827e-2)
    c = c * z * z - np.float32(0.5) * z + np.float32(1)
    odd = np.int32(quarter & np.int32(1))
    sine = c if odd else s
    cosine = s if odd else c
    sine = -sine if np.int32(quarter & np.int32(2)) else sine
    cosine = -cosine if np.int32(np.int32(quarter + np.int32(1)) & np.int32(2)) else cosine
    return sine, cosine


@numba.njit(**INNER)
def draw_words(first, key0, key1, out_a, out_b, out_c, out_d):
    """Four words (uint32) for each of the photons first, first + 1, ..."""
    for n in range(np.uint64(out_d.size)):
        count = np.uint64(first) + np.uint64(n)
        out_a[n], out_b[n], out_c[n], out_d[n] = philox(
            np.uint32(count & np.uint64(0xFFFFFFFF)),
            np.uint32(count >> np.uint64(32)),
            np.uint32(0),
            np.uint32(0),
            key0,
            key1,
        )


@numba.njit(**INNER)
def normals(word_a, word_b, out_x, out_y):
    """Two normal deviates from two words each, by Box and Muller (tails to 6.7 sigma)."""
    for n in range(np.uint64(word_a.size)):
        radius = np.sqrt(np.float32(-2) * log_uniform(word_b[n]))
        sine, cosine = sine_cosine(word_a[n])
        out_x[n] = radius * cosine
        out_y[n] = radius * sine


@numba.njit(**INNER)
def exponentials(word_c, out):
    """Exponential deviates of mean 1 from a word each."""
    for n in range(np.uint64(word_c.size)):
        out[n] = -log_uniform(word_c[n])


@numba.njit(cache=True, nogil=True)
def deviates(first, key0, key1, out_x, out_y, out_path, out_word):
    """Deviates of the photons first, first + 1, ...: two normal, one exponential, one word."""
    words = np.empty((3, out_x.size), np.uint32)
    # Loops of their own: in one, the processor waits for the ends of long chains of operations.
    draw_words(first, key0, key1, words[0], words[1], words[2], out_word)
    normals(words[0], words[1], out_x, out_y)
    exponentials(words[2], out_path)


@numba.njit(cache=True, nogil=True)
def uniforms(first, stream, key0, key1, out):
    """Two uniform deviates (0 to 1, both ends out) for each of the photons first, first + 1, ...

    ``stream`` sets them apart from other numbers of the same photons.
    """
    for n in range(out.shape[0]):
        count = np.uint64(first) + np.uint64(n)
        a, b, _, _ = philox(
            np.uint32(count & np.uint64(0xFFFFFFFF)),
            np.uint32(count >> np.uint64(32)),
            np.uint32(0),
            np.uint32(stream),
            key0,
            key1,
        )
        out[n, 0] = (np.float64(a) + 0.5) * 2.0**-32
        out[n, 1] = (np.float64(b) + 0.5) * 2.0**-32
