"""The ZIP of an exported folder stays whole for whoever is loading it down."""

import io
import os
import shutil
import time
import zipfile

from gcs_plugin.daemon.exports import zipped_folder


def exported(folder, text):
    folder.mkdir(exist_ok=True)
    (folder / "geo.txt").write_text(text)
    (folder / "picture.jpg").write_bytes(os.urandom(100_000))
    now = time.time_ns()  # finer than the file system's own clock, by which two exports may have one time
    os.utime(folder, ns=(now, now))


def test_a_zip_that_is_being_loaded_down_stays_whole_while_another_is_made(tmp_path):
    folder = tmp_path / "odm"
    exported(folder, "first")
    with zipped_folder(folder).open("rb") as loading:
        begun = loading.read(1000)
        inode = zipped_folder(folder).stat().st_ino
        assert inode == os.fstat(loading.fileno()).st_ino  # a second client gets the same file
        exported(folder, "second")
        newer = zipped_folder(folder)
        whole = zipfile.ZipFile(io.BytesIO(begun + loading.read()))
    assert whole.testzip() is None and whole.read("geo.txt") == b"first"
    assert zipfile.ZipFile(newer).read("geo.txt") == b"second"
    assert sorted(path.name for path in tmp_path.iterdir()) == ["odm", "odm.zip"]


def test_a_folder_that_is_exported_again_while_it_is_zipped_is_zipped_again(tmp_path, monkeypatch):
    folder = tmp_path / "odm"
    exported(folder, "first")
    write = zipfile.ZipFile.write

    def slow_write(self, *args, **named):
        write(self, *args, **named)
        if args[0].endswith("geo.txt"):
            shutil.rmtree(folder)
            exported(folder, "second")
            time.sleep(0.05)  # the ZIP is finished later, by the file system's clock

    monkeypatch.setattr(zipfile.ZipFile, "write", slow_write)
    zipped_folder(folder)
    monkeypatch.undo()
    zipped = zipped_folder(folder)
    assert zipfile.ZipFile(zipped).read("geo.txt") == b"second"
    assert zipped_folder(folder).stat().st_ino == zipped.stat().st_ino  # no third time
