"""The ZIP of an exported folder stays whole for whoever is loading it down."""

import io
import os
import zipfile

from gcs_plugin.daemon.exports import zipped_folder


def exported(folder, text):
    folder.mkdir(exist_ok=True)
    (folder / "geo.txt").write_text(text)
    (folder / "picture.jpg").write_bytes(os.urandom(100_000))
    os.utime(folder)


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
