"""Linear algebra on one thread: the live path's matrices are small, and its threads have work."""

from functools import cache


@cache
def limit_blas_threads() -> None:
    """Let BLAS use the calling thread alone, in the whole process, from now on.

    For a triangle of four by four its own threads wait for each other for milliseconds when the
    cores are busy; for the few hundred unknowns of a calibration they gain next to nothing.
    """
    # What is not loaded yet cannot be told: NumPy and SciPy have a BLAS each.
    import scipy.linalg  # noqa: F401
    from threadpoolctl import threadpool_limits

    threadpool_limits(limits=1, user_api="blas")
