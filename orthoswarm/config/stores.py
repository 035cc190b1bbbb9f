"""Files in object storage and behind web addresses. These change how long a run takes, never its products."""

from dataclasses import dataclass

from orthoswarm.config.ranges import from_zero


@dataclass(frozen=True, slots=True, kw_only=True)
class StoresConfig:
    """Files in object storage and behind web addresses. These change how long a run takes, never its products."""

    cache_mb: float = 8000.0
    """Disk space on each machine for copies of files from stores, megabytes; those used least recently go first
    (chosen: a flight of 500 photos of 12 megapixels takes 3 GB)."""
    cache_trust_s: float = from_zero(600.0)
    """A copy that was made or compared with its store in this run, and no longer ago, is used without asking, seconds
    (chosen: a request takes some 20 ms, and a picture is read two to four times in a run)."""
    held_s: float = from_zero(600.0)
    """A copy used no longer ago is not removed, seconds: another process may be about to open it (chosen)."""
    attempts: int = 5
    """Attempts at a request that fails, the first one included (chosen: with the waits below a store may be away for
    some seconds)."""
    first_wait_s: float = from_zero(0.5)
    """Wait before the second attempt, seconds; each further wait is twice as long (chosen; usual for S3)."""
    longest_wait_s: float = 10.0
    """Longest wait between two attempts, seconds (chosen)."""
    busy_s: float = 60.0
    """So long a store may answer that it has too much to do (429, 502, 503, 504) before the run ends, seconds (chosen:
    S3 takes some ten seconds to some minutes to spread a prefix that suddenly gets many requests)."""
    timeout_s: float = 30.0
    """Longest silence of a store within a request, seconds (chosen)."""
    connections: int = 16
    """Requests at once of a process that reads tags or uploads (chosen: a request mostly waits for the network)."""
    whole_kb: int = from_zero(512)
    """A picture file of no more kilobytes is fetched as a whole when its tags are read, since it is needed later anyhow
    (chosen: its transfer takes no longer than a second request)."""
    part_mb: int = 16
    """Files are uploaded in parts of so many megabytes (chosen; S3 allows 5 MB to 5 GB, 10,000 parts a file)."""
