"""Key files: who may read them, and what they hold."""

import os
import stat

import pytest

from companion.errors import InputError
from companion.link.key_file import load_key, new_key

SECRET = bytes(range(32))


def put(path, content, mode=0o600):
    path.write_bytes(content)
    path.chmod(mode)
    return path


@pytest.mark.parametrize("content", [SECRET, SECRET.hex().encode(), SECRET.hex().upper().encode() + b"\n"])
def test_raw_and_hexadecimal(tmp_path, content):
    assert load_key(put(tmp_path / "key", content)).secret == SECRET


def test_a_new_key_is_its_owners_alone(tmp_path):
    old = os.umask(0)
    try:
        made = new_key(tmp_path / "key")
    finally:
        os.umask(old)
    assert stat.S_IMODE((tmp_path / "key").stat().st_mode) == 0o600
    assert load_key(tmp_path / "key").secret == made.secret
    assert new_key(tmp_path / "other").secret != made.secret


def test_a_key_is_never_overwritten(tmp_path):
    put(tmp_path / "key", b"precious")
    with pytest.raises(InputError, match="never overwritten"):
        new_key(tmp_path / "key")
    assert (tmp_path / "key").read_bytes() == b"precious"
    with pytest.raises(InputError, match="No such file"):
        new_key(tmp_path / "nowhere" / "key")


@pytest.mark.parametrize("mode", [0o640, 0o604, 0o660, 0o610, 0o601, 0o620, 0o777])
def test_others_may_do_nothing_with_it(tmp_path, mode):
    with pytest.raises(InputError, match="chmod 600"):
        load_key(put(tmp_path / "key", SECRET, mode))


def test_a_foreign_owner_is_refused(tmp_path, monkeypatch):
    path = put(tmp_path / "key", SECRET)
    owner = path.stat().st_uid
    monkeypatch.setattr(os, "geteuid", lambda: owner + 1)
    with pytest.raises(InputError, match=f"belongs to user {owner}"):
        load_key(path)


@pytest.mark.parametrize(
    "content",
    [b"", SECRET[:31], SECRET + b"x", SECRET.hex().encode()[:-1], b"g" * 64, b"\xff" * 64, b"0x" + b"1" * 62],
)
def test_what_is_no_key(tmp_path, content):
    with pytest.raises(InputError, match="no key"):
        load_key(put(tmp_path / "key", content))


@pytest.mark.parametrize("content", [bytes(32), b"0" * 64])
def test_zeros_are_no_key(tmp_path, content):
    with pytest.raises(InputError, match="zeros"):
        load_key(put(tmp_path / "key", content))


def test_no_file_a_folder_and_a_pipe(tmp_path):
    with pytest.raises(InputError, match="companion key new"):
        load_key(tmp_path / "key")
    with pytest.raises(InputError, match=r"not a file|directory"):
        load_key(tmp_path)
    os.mkfifo(tmp_path / "pipe", 0o600)
    with pytest.raises(InputError, match="not a file"):
        load_key(tmp_path / "pipe")


@pytest.mark.parametrize("content", [SECRET + b"x", SECRET.hex().encode() + b"00", SECRET.hex().encode()[:-2] + b"zz"])
def test_messages_never_tell_what_is_in_the_file(tmp_path, content):
    with pytest.raises(InputError) as error:
        load_key(put(tmp_path / "key", content))
    told = str(error.value)
    for start in range(0, 60, 4):
        assert SECRET.hex()[start : start + 8] not in told
    assert error.value.__cause__ is None
