"""Execution of the work: compiled kernels, worker processes, a Dask cluster, the time of each stage."""
