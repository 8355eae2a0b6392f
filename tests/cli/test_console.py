"""Consoles without letters, closed and full outputs: no stack trace, and the files are what they should be."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
from command_line import avatar

from avatar.commands import doctor

# The installed script with a command of its own in place of all others: this starts within milliseconds.
SCRIPT = """
import os, sys
import avatar.cli
def main(**options):
{body}
avatar.cli.main = main
avatar.cli.run()
"""
WRITES_A_FILE = """
    with open("made", "wb") as file, open("also", "wb") as other:
        print("a sentence")
        os.write(1, b"of a library")
        os.write(2, b"of a library")
        print("a bar", file=sys.stderr)
        other.write(b"whole")
        file.write(b"whole")
    return 0
"""


def shell(body: str, folder: Path, redirection: str = "", **environment: str) -> subprocess.CompletedProcess[bytes]:
    """A command with the redirections of a shell, and with its output buffered as it usually is."""
    kept = {name: value for name, value in os.environ.items() if name != "PYTHONUNBUFFERED"}
    line = f'exec "$0" -c "$1" {redirection}'
    words = ["bash", "-c", line, sys.executable, SCRIPT.format(body=body)]
    return subprocess.run(words, cwd=folder, env=kept | environment, capture_output=True, timeout=60)


@pytest.mark.parametrize("encoding", ["ascii", "cp437", "cp1252", "utf-8"])
@pytest.mark.parametrize("text", ["Ελένη’s Zoë …", "Zo\udceb"])
def test_a_console_that_lacks_a_letter_is_written_to(encoding: str, text: str, tmp_path: Path) -> None:
    done = shell(f"    print({text!a})\n    return 0", tmp_path, PYTHONIOENCODING=encoding)
    assert done.returncode == 0 and done.stderr == b""
    assert done.stdout == f"{text}\n".encode(encoding, "backslashreplace")


@pytest.mark.parametrize("closed", [">&-", "2>&-", "<&-", ">&- 2>&-", ">&- 2>&- <&-"])
def test_closed_output_goes_nowhere_and_into_no_file(closed: str, tmp_path: Path) -> None:
    """A file that is opened gets the lowest free number, which must not be that of an output."""
    done = shell(WRITES_A_FILE, tmp_path, closed)
    assert done.returncode == 0 and b"Traceback" not in done.stderr
    assert (tmp_path / "made").read_bytes() == (tmp_path / "also").read_bytes() == b"whole"
    assert (done.stdout == b"") == (">&-" in closed.split()) and (done.stderr == b"") == ("2>&-" in closed.split())


@pytest.mark.parametrize(
    "body",
    ["    print('a sentence')\n    return 0", "    print('usage')\n    sys.exit(0)", "    print('x')\n    return 2"],
)
def test_output_onto_a_full_disk_is_one_sentence(body: str, tmp_path: Path) -> None:
    if not Path("/dev/full").exists():
        pytest.skip("there is no /dev/full")
    done = shell(body, tmp_path, "> /dev/full")
    said = b"" if "return 2" in body else b"avatar: the output cannot be written (No space left on device)\n"
    assert (done.returncode, done.stderr) == (2 if "return 2" in body else 1, said)


def test_help_that_nobody_reads_is_no_error_to_show(tmp_path: Path) -> None:
    """`avatar train --help | true`."""
    done = shell("    print('usage')\n    sys.exit(0)", tmp_path, "| true")
    assert done.stderr == b""


def test_a_name_that_a_library_cannot_take_is_a_sentence(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(doctor, "run_doctor", lambda _: "runs/Zo\udceb".encode())
    output = avatar("doctor", status=1)
    assert output.startswith("avatar: runs/Zo") and "not UTF-8" in output and output.count("\n") == 1
    monkeypatch.setattr(doctor, "run_doctor", lambda _: "…".encode("ascii"))
    with pytest.raises(UnicodeEncodeError):  # a mistake of the program
        avatar("doctor")


def test_a_user_without_a_home_and_without_a_name_has_a_cache(tmp_path: Path) -> None:
    """As in a container that is started with `docker run -u 12345`."""
    enter = ["unshare", "--user", "--map-user=12345", "--map-group=12345"]
    if shutil.which("unshare") is None or subprocess.run([*enter, "true"], capture_output=True).returncode != 0:
        pytest.skip("unshare makes no users here")
    script = "from avatar.files.environment import cache_folder; print(cache_folder())"
    where = {"PATH": os.environ["PATH"], "TMPDIR": str(tmp_path)}
    done = subprocess.run([*enter, sys.executable, "-c", script], env=where, capture_output=True, text=True, timeout=60)
    assert (done.stdout, done.stderr) == (f"{tmp_path / 'avatar-12345'}\n", "")
