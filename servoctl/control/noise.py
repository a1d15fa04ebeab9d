"""Normally distributed numbers by counter: each follows from a seed, a channel and its place in it alone.

The words are those of Philox 4x64-10 (Salmon, Moraes, Dror, Shaw, "Parallel random numbers: as easy as 1, 2, 3", SC
2011), as ``numpy.random.Philox`` gives them; Box and Muller's transformation makes two numbers of two words. Compiled
code and NumPy agree to rounding.
"""

import ctypes
from functools import cache

import numpy as np

from servoctl.codegen import compiler, emit
from servoctl.codegen.native import pointer

_WORD = 2**64  # values of a word of the counter


def key(seed):
    """The two words of a seed, (2,) uint64: its remainder by 2^128."""
    return np.array([seed % _WORD, seed // _WORD % _WORD], dtype=np.uint64)


def normal(seed, count, channels):
    """Standard normal numbers of some channels, (count, len(channels))."""
    y = np.empty((count, len(channels)))
    for column, channel in zip(y.T, channels, strict=True):
        words = np.random.Philox(key=key(seed), counter=[0, channel, 0, 0]).random_raw(4 * -(-count // 4))
        radial, angular = np.moveaxis((words >> np.uint64(11)).reshape(-1, 2, 2), 2, 0)
        r, a = np.sqrt(-2.0 * np.log((radial + np.uint64(1)) * 2.0**-53)), angular * (2.0**-52 * np.pi)
        column[:] = np.stack([r * np.cos(a), r * np.sin(a)], axis=-1).ravel()[:count]
    return y


def first_words(seed, kind, count):
    """The first word of channels 0 .. count - 1 of a kind, (count,) uint64; noise is kind 0."""
    y, library = np.empty(count, dtype=np.uint64), _library(compiler.compiler())
    if library is None:
        words = (np.random.Philox(key=key(seed), counter=[0, channel, kind, 0]) for channel in range(count))
        return np.array([word.random_raw() for word in words], dtype=np.uint64)
    library.first_words(pointer(key(seed)), ctypes.c_int64(kind), ctypes.c_int64(count), pointer(y))
    return y


@cache
def _library(_compiler):
    """The compiled function for a compiler; None without one."""
    return compiler.library(f"{emit.unit({'NAME': 'normal'})}{emit.include('normal.c')}", level="-O3")
