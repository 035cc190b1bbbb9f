"""The package's exceptions; each message is one sentence that tells the user what to do next."""


class OrthoSwarmError(Exception):
    """Nothing could be made of otherwise valid input (exit code 1)."""

    exit_code = 1


class InputError(OrthoSwarmError):
    """An argument or an input file is wrong (exit code 2)."""

    exit_code = 2


class AdjustmentError(OrthoSwarmError):
    """Pictures of a vehicle do not hold together: their adjustment is singular."""


class StorageError(OrthoSwarmError):
    """A file cannot be written, or its disk not reached; the same may succeed later."""


class DiskFullError(StorageError):
    """There is no room left on the disk."""


class WorkerStoppedError(OrthoSwarmError):
    """A worker process was ended from outside, mostly for lack of memory; the same may succeed later."""
