"""The command line."""

from calib_ros.runtime import return_freed_memory, use_one_blas_thread

use_one_blas_thread()
return_freed_memory()  # which maps of every frame would be cleared for anew
