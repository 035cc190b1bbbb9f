"""Where and how work runs: compiled kernels, worker processes, a Dask cluster, the time of each stage."""
