# type: ignore (this is Warp's language: arrays of vectors, `int / int`, ...)

"""Kernels of the convolution of a map along its columns (`Backend.prefilter`), and of its adjoint.

The Fourier transforms along the columns are sums, which are fast for maps of few columns. `waves` holds cosines and
sines of all frequencies at all columns; a *spectrum* has real and imaginary part, frequency and row. The transforms of
the lobes are real, so that the adjoint of each step is the same step backwards.
"""

import warp as wp

from tumble.backends._warp.runtime import no_type_check

wp.set_module_options({"enable_backward": False})


@wp.func
@no_type_check
def inverse_factor(f: int, width: int) -> float:
    """Factor of a frequency in the inverse transform: all but the first and the last occur twice."""
    return wp.where(f == 0 or 2 * f == width, 1.0, 2.0) / float(width)


@wp.kernel
@no_type_check
def transform(
    maps: wp.array2d[wp.vec3], first: int, inverse: int, waves: wp.array3d[float], spectrum: wp.array3d[wp.vec3]
):
    """Transforms of rows from `first` on, or (inverse = 1) the adjoint of their inverse transforms."""
    f, row = wp.tid()
    real = wp.vec3()
    imaginary = wp.vec3()
    for column in range(maps.shape[1]):
        x = maps[first + row, column]
        real += waves[0, f, column] * x
        imaginary -= waves[1, f, column] * x
    factor = wp.where(inverse == 1, inverse_factor(f, maps.shape[1]), 1.0)
    spectrum[0, f, row] = factor * real
    spectrum[1, f, row] = factor * imaginary


@wp.kernel
@no_type_check
def multiply(spectrum: wp.array3d[wp.vec3], lobes: wp.array3d[float], out: wp.array3d[wp.vec3]):
    """Spectra of all rows of the result from those of the map; lobes are indexed by frequency, result and map."""
    f, row = wp.tid()
    real = wp.vec3()
    imaginary = wp.vec3()
    for k in range(spectrum.shape[2]):
        real += lobes[f, row, k] * spectrum[0, f, k]
        imaginary += lobes[f, row, k] * spectrum[1, f, k]
    out[0, f, row] = real
    out[1, f, row] = imaginary


@wp.kernel
@no_type_check
def transform_back(
    base: wp.array2d[wp.vec3],
    copied: int,
    inverse: int,
    spectrum: wp.array3d[wp.vec3],
    waves: wp.array3d[float],
    out: wp.array2d[wp.vec3],
):
    """The first rows of `base`, and below these inverse transforms (inverse = 1); or added to them, as adjoints."""
    row, column = wp.tid()
    below = row - copied * inverse
    x = wp.vec3()
    if row < copied:
        x = base[row, column]
    if below >= 0:
        for f in range(spectrum.shape[1]):
            factor = wp.where(inverse == 1, inverse_factor(f, out.shape[1]), 1.0)
            x += factor * (waves[0, f, column] * spectrum[0, f, below] - waves[1, f, column] * spectrum[1, f, below])
    out[row, column] = x
