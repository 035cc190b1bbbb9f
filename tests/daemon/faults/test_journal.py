"""The journal: commits together, undoes alone, holds any text."""

import contextlib
import sqlite3
import threading

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from gcs_plugin.daemon.store.frame_rows import add_frame
from gcs_plugin.daemon.store.journal import Journal, packed, unpacked
from gcs_plugin.daemon.store.picture_store import frame_key
from orthoswarm.model.errors import OrthoSwarmError

ANY_TEXT = st.text(st.characters(), max_size=60)  # lone surrogates and NUL included


def frame(journal, vehicle, image, time_s=1.0):
    change = add_frame(
        frame_key(vehicle, image), vehicle, image, time_s=time_s, path="ab/x.jpg", size=(4, 3), pose={"lat_deg": 1.0}
    )
    return journal.write(change)


@pytest.fixture
def journal(tmp_path):
    journal = Journal(tmp_path / "journal.db")
    yield journal
    journal.close()


@settings(max_examples=25)
@given(vehicle=ANY_TEXT, image=ANY_TEXT)
def test_any_name_comes_back_as_it_came(tmp_path_factory, vehicle, image):
    journal = Journal(tmp_path_factory.mktemp("j") / "journal.db")
    try:
        assert frame(journal, vehicle, image) == (1, True)
        row = journal.one("SELECT * FROM frames")
        assert (unpacked(row["vehicle"]), unpacked(row["image"])) == (vehicle, image)
    finally:
        journal.close()


@given(st.tuples(ANY_TEXT, ANY_TEXT), st.tuples(ANY_TEXT, ANY_TEXT))
def test_only_equal_names_have_equal_keys(one, other):
    assert (frame_key(*one) == frame_key(*other)) == (one == other)


def test_a_picture_is_entered_once(journal):
    assert frame(journal, "v1", "a.jpg") == (1, True)
    assert frame(journal, "v1", "a.jpg") == (1, False)
    number, new = frame(journal, "v2", "a.jpg")
    assert number > 1
    assert new


def test_a_change_that_fails_is_undone_alone(journal):
    def bad(db: sqlite3.Connection) -> None:
        db.execute("INSERT INTO meta VALUES ('half', '1')")
        raise ValueError("no")

    gate = threading.Event()
    first = journal.submit(lambda db: gate.wait(120))  # so that the others share a batch
    failing, good = journal.submit(bad), journal.submit(lambda db: db.execute("INSERT INTO meta VALUES ('b', '2')"))
    gate.set()
    first.result()
    good.result()
    with pytest.raises(ValueError, match="no"):
        failing.result()
    assert journal.fact("half") is None
    assert journal.fact("b") == 2


def test_many_writers_share_commits(journal):
    def write(n):
        for k in range(25):
            frame(journal, f"v{n}", f"{k}.jpg")

    threads = [threading.Thread(target=write, args=(n,)) for n in range(8)]
    before = journal.commits
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert len(journal.rows("SELECT seq FROM frames")) == 200
    assert journal.commits - before < 200


def test_what_was_written_is_there_after_reopening(tmp_path):
    first = Journal(tmp_path / "journal.db")
    frame(first, "v1", "a.jpg")
    first.remember("area", {"epsg": 32631})
    second = Journal(tmp_path / "journal.db")  # the first was not closed, as after a kill
    assert second.fact("area") == {"epsg": 32631}
    assert len(second.rows("SELECT seq FROM frames")) == 1
    second.close()
    first.close()


def test_a_file_that_is_no_journal_is_refused_in_words(tmp_path):
    (tmp_path / "journal.db").write_bytes(b"this is not a database at all, but long enough to be one" * 20)
    with pytest.raises(OrthoSwarmError, match="cannot be opened"):
        Journal(tmp_path / "journal.db")


@pytest.mark.parametrize("table", ["frames", "jobs", "meta"])
def test_a_damaged_journal_is_told_at_the_start(tmp_path, table):
    path = tmp_path / "journal.db"
    whole = Journal(path)
    frame(whole, "v1", "a.jpg")
    whole.close()
    with contextlib.closing(sqlite3.connect(path)) as db:
        (page,) = db.execute("SELECT rootpage FROM sqlite_master WHERE name = ?", (table,)).fetchone()
        (size,) = db.execute("PRAGMA page_size").fetchone()
    data = bytearray(path.read_bytes())
    data[(page - 1) * size : page * size] = b"\xa5" * size
    path.write_bytes(data)
    with pytest.raises(OrthoSwarmError, match=r"is damaged; rescue .* \.recover"):
        Journal(path)


def test_packed_text_is_ascii():
    assert packed("\ud800\x00é").isascii()
