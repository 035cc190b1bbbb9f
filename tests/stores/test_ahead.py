"""Files are copied ahead by several threads, and nobody waits for one whose turn has not come."""

import threading
from pathlib import Path

from orthoswarm.stores.local_copies import Ahead

A, B, C = Path("/s3:/b/a"), Path("/s3:/b/b"), Path("/s3:/b/c")


def test_announced_files_are_copied_at_the_same_time():
    both = threading.Barrier(2, timeout=240)
    ahead = Ahead(lambda path: both.wait())
    ahead.announce([A, B], threads=2)
    ahead.wait(A)
    ahead.wait(B)
    assert not both.broken


def test_a_file_that_is_being_copied_is_waited_for_and_a_later_one_is_left_to_the_caller():
    begun, go, copied = threading.Event(), threading.Event(), []

    def copy(path):
        begun.set()
        go.wait(240)
        copied.append(path)

    ahead = Ahead(copy)
    ahead.announce([A, B, C], threads=1)
    assert begun.wait(240)
    ahead.wait(B)  # returns at once: the caller copies it
    threading.Timer(0.05, go.set).start()
    ahead.wait(A)
    assert copied[0] == A
    assert B not in copied


def test_a_copy_that_fails_does_not_stop_the_others():
    done = threading.Event()

    def copy(path):
        if path == A:
            raise OSError("gone")
        done.set()

    ahead = Ahead(copy)
    ahead.announce([A, B], threads=1)
    assert done.wait(240)
    ahead.wait(A)
