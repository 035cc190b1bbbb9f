"""An output folder in a store: written locally, uploaded as a whole when it is complete.

A file appears in a store when all of it is there, and `report.json` appears last: whoever finds it finds all that
belongs to it. An upload that was interrupted goes on with the files that are missing.
"""

import json
import os
import shutil
from collections.abc import Callable, Generator, Sequence
from concurrent.futures import ThreadPoolExecutor, as_completed
from contextlib import closing
from hashlib import blake2b
from pathlib import Path
from typing import Final
from uuid import uuid4

from orthoswarm.model.errors import InputError, OrthoSwarmError, RunInterruptedError
from orthoswarm.model.task_runner import Progress
from orthoswarm.stores.addresses import address_of
from orthoswarm.stores.listing import list_folder
from orthoswarm.stores.local_copies import cache_folder
from orthoswarm.stores.requests import CONNECTIONS, NotStoredError, request

_LAST = "report.json"
_RECORD = ".uploaded"
_PART_BYTES: Final = 16 << 20  # files are uploaded in parts (S3 allows 5 MB to 5 GB, 10,000 parts a file)


class PublishedFolder:
    """The local folder of a map that is to lie in a store.

    It is the same for each run to an address on this machine, so that an interrupted run goes on in it, and is removed
    after the upload. Whoever publishes holds the local folder against other runs until that is over.

    Attributes:
        address: where the map is to lie. local: the folder to write to, of the same name.

    Raises InputError: if nothing can be written at the address; StoreLostError: if the store cannot be reached.
    """

    def __init__(self, address: Path) -> None:
        self.address = address
        place = blake2b(address_of(address).encode(), digest_size=12).hexdigest()
        self.local = cache_folder() / "maps" / place / address.name
        _require_writable(address)

    def publish(self, written: Callable[[str], bool], progress: Progress | None = None) -> None:
        """Upload all files and remove them here; hidden ones, of a run that is not complete yet, stay.

        Args:
            written: whether runs write files of such a name (path in the folder); those of an earlier run that this one
                has not written are removed from the store. progress: called during the upload.

        Raises:
            OrthoSwarmError: if a file cannot be uploaded; the local files stay, and the next run uploads the rest.
        """
        names = sorted(_files(self.local), key=lambda name: (name == _LAST, name))
        sent = self._sent()
        there = {path.relative_to(self.address).as_posix() for path in list_folder(self.address)}
        if _LAST in there and _LAST not in sent:
            self._remove(_LAST)
        wanted = [name for name in names if sent.get(name) != self._state(name) or name not in there]
        with closing(self._sending([name for name in wanted if name != _LAST])) as arrived:
            for done, name in enumerate(arrived, 1):
                sent[name] = self._state(name)
                self._record(sent)
                if progress is not None:
                    progress("uploading", done, len(wanted))
        for name in sorted(there - set(names)):
            if written(name) and name != _LAST:
                self._remove(name)
        if _LAST in wanted:
            self._send(_LAST)
        (self.local / _RECORD).unlink(missing_ok=True)
        for entry in self.local.glob("[!.]*"):
            if entry.is_dir():
                shutil.rmtree(entry, ignore_errors=True)
            else:
                entry.unlink(missing_ok=True)

    def folders(self) -> list[Path]:
        """The folders to be removed when nothing is left in them, the innermost first."""
        return [self.local, self.local.parent]

    def _sending(self, names: Sequence[str]) -> Generator[str, None, None]:
        """Upload several files at once; yields the name of each that has arrived, also after one that fails.

        Whoever leaves it early, as Ctrl-C does, waits for the files under way only.

        Raises OrthoSwarmError: when those that were under way have ended, if a file cannot be uploaded.
        """
        failed: BaseException | None = None
        with ThreadPoolExecutor(CONNECTIONS) as pool:
            try:
                sending = [pool.submit(self._send, name) for name in names]
                for each in as_completed(sending):
                    if each.cancelled():
                        continue
                    if (error := each.exception()) is None:
                        yield each.result()
                    else:
                        failed = failed or error
                        for other in sending:
                            other.cancel()
            finally:
                pool.shutdown(wait=False, cancel_futures=True)
        if failed is not None:
            raise failed

    def _send(self, name: str) -> str:
        local = str(self.local / name)
        request(self.address / name, lambda system, key: system.put_file(local, key, chunksize=_PART_BYTES))
        return name

    def _remove(self, name: str) -> None:
        request(self.address / name, lambda system, key: system.rm_file(key))

    def _state(self, name: str) -> list[int]:
        state = (self.local / name).stat()
        return [state.st_size, state.st_mtime_ns]

    def _sent(self) -> dict[str, list[int]]:
        """What an interrupted upload has sent: name -> size and time of the local file."""
        try:
            sent: dict[str, list[int]] = json.loads((self.local / _RECORD).read_text(encoding="utf-8"))
        except (OSError, ValueError):
            return {}
        return sent

    def _record(self, sent: dict[str, list[int]]) -> None:
        part = self.local / f"{_RECORD}.part"
        part.write_text(json.dumps(sent), encoding="utf-8")
        os.replace(part, self.local / _RECORD)


def _files(folder: Path) -> list[str]:
    """All files below a folder without hidden ones, relative to it."""
    found = []
    for here, below, names in os.walk(folder):
        below[:] = [name for name in below if not name.startswith(".")]
        found += [(Path(here) / name).relative_to(folder).as_posix() for name in names if not name.startswith(".")]
    return found


def _require_writable(address: Path) -> None:
    """Refuse now what would fail after hours of work."""
    text = address_of(address)
    if address.parts[1].startswith("http"):
        raise InputError(f"nothing can be written to {text}; give --out a local folder or an s3:// or gs:// address")
    probe = address / f".writable-{uuid4().hex}"
    try:
        request(probe, lambda system, key: system.pipe_file(key, b"orthoswarm"))
        request(probe, lambda system, key: system.rm_file(key))
    except RunInterruptedError:
        raise
    except NotStoredError:
        raise InputError(f"{text} cannot be written: there is no such bucket, or it is refused; check --out") from None
    except OrthoSwarmError as error:
        raise InputError(f"{text} cannot be written ({error})") from None
