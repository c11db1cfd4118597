"""What a process of this package asks of the libraries below NumPy: threads of the linear algebra, and memory."""

from __future__ import annotations

import os
from contextlib import suppress

# Options of mallopt, and their values, in glibc's malloc.h.
M_TRIM_THRESHOLD, M_MMAP_THRESHOLD, M_ARENA_MAX = -1, -3, -8
# Bytes. Arrays of one scan stay below it: to map and clear each of them anew took a third of the CPU time.
MMAP_THRESHOLD, TRIM_THRESHOLD = 4 << 20, 64 << 20
ARENAS = 2


def use_one_blas_thread() -> None:
    """Keep OpenBLAS and MKL to one thread in this process, unless the environment says otherwise. To be called before NumPy is
    imported."""
    # The matrices here are small: more threads wait for each other and take a third more CPU time.
    if "OMP_NUM_THREADS" in os.environ:  # which the variables of the libraries would take precedence over
        return
    for name in ("OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
        os.environ.setdefault(name, "1")


def trim_memory() -> None:
    """Give back what lies free between arrays that are kept; takes some ten milliseconds, and does nothing without glibc."""
    import ctypes

    with suppress(AttributeError, OSError, TypeError):
        ctypes.CDLL(None).malloc_trim(0)


def return_freed_memory() -> None:
    """Let glibc map every large array on its own; does nothing with another C library. To be called before threads start."""
    # By default it keeps the places of freed arrays: of many sizes, their gaps let the memory grow by a sixth in ten minutes.
    import ctypes  # five milliseconds in which a process could not be ready for signals

    with suppress(AttributeError, OSError, TypeError):
        mallopt = ctypes.CDLL(None).mallopt
        mallopt(M_MMAP_THRESHOLD, MMAP_THRESHOLD)
        mallopt(M_TRIM_THRESHOLD, TRIM_THRESHOLD)
        mallopt(M_ARENA_MAX, ARENAS)
