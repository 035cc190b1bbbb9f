"""The failures that callers tell apart. Each message is one sentence that tells the user what to do next.

    Exception
    ├── OrthoSwarmError                nothing could be made of valid input (exit code 1)
    │   ├── InputError                 an argument or an input file is wrong (exit code 2)
    │   │   └── UnreadableMapError     the basemap cannot be read here      raster.map_check
    │   ├── AdjustmentError            photos of a vehicle cannot be adjusted
    │   ├── PictureError               a picture cannot be decoded          raster.picture_file
    │   ├── StorageError               a file cannot be written; the same may succeed later
    │   │   └── DiskFullError          there is no room on the disk
    │   ├── WorkerStoppedError         a worker process was killed
    │   ├── RunInterruptedError        a run cannot go on now; the same command goes on later
    │   │   ├── ClusterLostError       a cluster's scheduler or workers are gone    compute.dask_cluster
    │   │   ├── StoreLostError         a store cannot be reached        stores.requests
    │   │   ├── StoreAccessError       a store is refused (also an InputError)  stores.requests
    │   │   └── CacheFullError         no room for copies (also a StorageError)     stores.local_copies
    │   ├── NotStoredError             a file is not in its store       stores.requests
    │   │   └── RefusedError           one file may not be read or written      stores.requests
    │   ├── StoreRequestError          a store refuses one request      stores.requests
    │   ├── SolutionFileError          a refined sortie's file is damaged or old    gcs_plugin.daemon.jobs.solution_file
    │   ├── OutdatedError              the shared plan was changed by another user meanwhile  gcs_plugin.daemon.store
    │   ├── Preempted                  a job gave way to one of higher priority     gcs_plugin.daemon.jobs.job_queue
    │   └── TooLarge                   a request's body is too large        gcs_plugin.web.guard
    ├── UnavailableError               a matcher's weights or packages are missing  matchers.matcher
    └── Unreadable                     bytes are not of the format they claim       telemetry.samples.unreadable

The last two do not end a run: their callers use the next matcher, or reject the file with the reason.
"""


class OrthoSwarmError(Exception):
    """Nothing could be made of otherwise valid input (exit code 1)."""

    exit_code = 1


class InputError(OrthoSwarmError):
    """An argument or an input file is wrong (exit code 2)."""

    exit_code = 2


class AdjustmentError(OrthoSwarmError):
    """Photos of a vehicle cannot be adjusted: no tie points connect them, or few observations fit the result."""


class StorageError(OrthoSwarmError):
    """A file cannot be written, or its disk not reached; the same may succeed later."""


class DiskFullError(StorageError):
    """There is no room left on the disk."""


class RunInterruptedError(OrthoSwarmError):
    """A run cannot go on because of something outside it; what is done is kept, and the same command goes on."""


class WorkerStoppedError(OrthoSwarmError):
    """A worker process was killed, mostly for lack of memory; the same may succeed later."""
