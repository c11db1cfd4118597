"""Threads of the linear algebra below NumPy."""

from __future__ import annotations

import os


def use_one_blas_thread() -> None:
    """Keep OpenBLAS and MKL to one thread in this process, unless the environment says otherwise.

    To be called before NumPy is imported. The matrices here are small: more threads wait for each other and take a third more CPU
    time for the same result.
    """
    if "OMP_NUM_THREADS" in os.environ:  # which the variables of the libraries would take precedence over
        return
    for name in ("OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
        os.environ.setdefault(name, "1")
