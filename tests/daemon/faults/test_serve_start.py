"""Starting `orthoswarm serve`: the link with the token, again and again, and a workspace for its owner only."""

import subprocess
import sys

from tests.kit.daemon_kit import line, serving


def show(workspace, *more):
    words = [sys.executable, "-m", "gcs_plugin.cli", "serve", "--workspace", str(workspace), "--show-token", *more]
    return subprocess.run(words, capture_output=True, text=True, timeout=240)


def test_the_link_with_the_token_is_printed_at_each_start_and_when_asked_for(tmp_path):
    workspace = tmp_path / "w"
    with serving(workspace) as served:
        link = f"map: {served.url}/#token={served.token}\n"
        assert served.said[0] == link
        assert workspace.stat().st_mode & 0o077 == 0  # of a new one
        shown = show(workspace)
        assert shown.returncode == 0 and shown.stdout.startswith(link)  # of the one that runs, whatever its port is
    with serving(workspace) as again:
        assert again.said[0] == f"map: {again.url}/#token={served.token}\n"


def test_the_token_can_be_had_before_the_first_start(tmp_path):
    shown = show(tmp_path / "w", "--port", "8123")
    token = (tmp_path / "w" / "token").read_text().strip()
    assert shown.stdout.splitlines() == [f"map: http://127.0.0.1:8123/#token={token}", f"token: {token}"]


def test_a_folder_that_was_there_becomes_readable_for_its_owner_only(tmp_path):
    workspace = tmp_path / "old"
    workspace.mkdir(mode=0o755)
    with serving(workspace) as served:
        assert served.send(line(1)[0]).status_code == 201
        assert workspace.stat().st_mode & 0o077 == 0
    assert [path for path in workspace.rglob("*.jpg") if path.stat().st_mode & 0o077] == []
