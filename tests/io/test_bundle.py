"""Files of bundles: content, names, digests, and what is refused."""

import hashlib
import json
import re
import struct
import warnings
import zipfile
from io import BytesIO

import pytest

from dhcal_pin.exceptions import FileFormatError
from dhcal_pin.io import bundle as bundles
from dhcal_pin.io.bundle import Bundle, bundle_bytes, is_bundle, read_bundle

BUNDLE = Bundle(
    options={"extend": "none"},
    versions={"dhcal_pin": "1.0"},
    joints=("j1", "j2"),
    tip="tool",
    result={"samples": 20},
    inputs={"b.csv": b"2", "a/b.csv": b"1" * 1000},
    outputs={"out.urdf": b"<robot/>"},
)


def written(path, members, comment=None):
    """Write a zip file with members, whose names may repeat, and the comment of a bundle."""
    out = BytesIO()
    with warnings.catch_warnings(), zipfile.ZipFile(out, "w") as archive:
        warnings.simplefilter("ignore")
        for name, data in members:
            info = zipfile.ZipInfo("x")
            info.filename = name
            archive.writestr(info, data)
        manifest = dict(members).get("manifest.json", b"")
        archive.comment = hashlib.sha256(manifest).hexdigest().encode() if comment is None else comment
    path.write_bytes(out.getvalue())
    return path


def members_of(data):
    """Return the members of a zip file in their order."""
    with zipfile.ZipFile(BytesIO(data)) as archive:
        return [(info.filename, archive.read(info)) for info in archive.infolist()]


def with_members(members):
    """Return members with a manifest that states their digests."""
    manifest = json.loads(dict(members_of(bundle_bytes(BUNDLE)))["manifest.json"])
    manifest["sha256"] = {name: hashlib.sha256(data).hexdigest() for name, data in members}
    return [("manifest.json", json.dumps(manifest).encode()), *members]


def test_a_bundle_is_read_as_it_was_written(tmp_path):
    (tmp_path / "b.dhcal.zip").write_bytes(bundle_bytes(BUNDLE))
    assert read_bundle(tmp_path / "b.dhcal.zip") == BUNDLE
    assert bundle_bytes(BUNDLE) == (tmp_path / "b.dhcal.zip").read_bytes()


def test_members_are_compressed_readable_and_in_order():
    data = bundle_bytes(BUNDLE)
    members = members_of(data)
    names = ["inputs/a/b.csv", "inputs/b.csv", "outputs/out.urdf", "result.json"]
    assert [name for name, _ in members] == ["manifest.json", *names]
    manifest = json.loads(dict(members)["manifest.json"])
    assert (manifest["format"], manifest["version"]) == ("dhcal bundle", 1)
    assert manifest["sha256"] == {name: hashlib.sha256(dict(members)[name]).hexdigest() for name in names}
    with zipfile.ZipFile(BytesIO(data)) as archive:
        assert archive.comment.decode() == hashlib.sha256(members[0][1]).hexdigest()
        for info in archive.infolist():
            assert info.date_time == (1980, 1, 1, 0, 0, 0)
            assert info.compress_type == zipfile.ZIP_DEFLATED
            # Permissions of Unix: all may read, the owner may write.
            assert (info.create_system, info.external_attr >> 16) == (3, 0o644)
        assert archive.getinfo("inputs/a/b.csv").compress_size < 100


@pytest.mark.parametrize(
    ("name", "expected"),
    [("arm.dhcal.zip", True), ("A.DHCAL.ZIP", True), ("arm.zip", False), ("arm.dhcal.zip.txt", False)],
)
def test_bundles_are_told_by_their_names(name, expected):
    assert is_bundle(name) == expected


@pytest.mark.parametrize(
    "name", ["/a", "a//b", "a/", "..", "a/../b", "./a", "a\\b", "C:/a", "C:a", "inputs/\0a", ""]
)
def test_unsafe_names_are_refused(tmp_path, name):
    path = written(tmp_path / "b.dhcal.zip", with_members([(name, b"x"), ("result.json", b"{}")]))
    with pytest.raises(FileFormatError, match=r"unsafe name of a member: .*; expected names inside"):
        read_bundle(path)


def test_names_with_colons_and_points_inside_are_safe(tmp_path):
    members = [("result.json", b"{}"), ("inputs/a:b.csv", b"1"), ("outputs/..x/.y", b"2")]
    found = read_bundle(written(tmp_path / "b.dhcal.zip", with_members(members)))
    assert (found.inputs, found.outputs) == ({"a:b.csv": b"1"}, {"..x/.y": b"2"})


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda members: [*members, members[-1]], "two members have the same name"),
        (lambda members: members[1:], "no manifest of a bundle"),
        (lambda members: members[:-1], "'result.json' was changed after the calibration"),
        (lambda members: [*members, ("inputs/c.csv", b"")], "'inputs/c.csv' was changed"),
        (lambda members: [*members[:-1], ("result.json", b"{ }")], "'result.json' was changed"),
        (lambda members: with_members(members[1:-1]), "no result.json; expected a bundle of"),
        (lambda members: with_members([("result.json", b"[]")]), "no result.json"),
        (lambda members: with_members([("result.json", b"{")]), "no result.json"),
    ],
)
def test_changed_members_are_named(tmp_path, change, message):
    members = members_of(bundle_bytes(BUNDLE))
    path = written(tmp_path / "b.dhcal.zip", change(members))
    with pytest.raises(FileFormatError, match=re.escape(f"{path}: {message}")):
        read_bundle(path)


def test_a_changed_manifest_is_named(tmp_path):
    members = members_of(bundle_bytes(BUNDLE))
    with pytest.raises(FileFormatError, match=r"'manifest.json' was changed"):
        read_bundle(written(tmp_path / "b.dhcal.zip", members, b"0" * 64))


def test_limits_of_the_content(tmp_path, monkeypatch):
    members = members_of(bundle_bytes(BUNDLE))
    path = written(tmp_path / "b.dhcal.zip", members)
    size = sum(len(data) for _, data in members)
    for name, limit in (("MAX_MEMBERS", 5), ("MAX_BYTES", size)):
        with monkeypatch.context() as patch:
            patch.setattr(bundles, name, limit)
            read_bundle(path)
            patch.setattr(bundles, name, limit - 1)
            with pytest.raises(FileFormatError, match=r"content is too large; expected at most"):
                read_bundle(path)
    monkeypatch.setattr(bundles, "MAX_MEMBERS", 4)
    with pytest.raises(FileFormatError, match="at most 4 files, 1024 MiB"):
        read_bundle(path)


def test_a_wrong_size_is_named(tmp_path):
    path = tmp_path / "b.dhcal.zip"
    data = bytearray(bundle_bytes(BUNDLE))
    # The size is at byte 24 of the entry of the directory.
    place = data.index(b"PK\x01\x02", data.index(b"PK\x01\x02") + 1) + 24
    (size,) = struct.unpack_from("<I", data, place)
    struct.pack_into("<I", data, place, size + 1)
    path.write_bytes(data)
    with pytest.raises(FileFormatError, match=r"the size of 'inputs/a/b.csv' is wrong; expected a bundle"):
        read_bundle(path)


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (None, "cannot read it: .*; give the path of a bundle"),
        (b"text", "not a bundle or damaged: .*; expected a zip"),
    ],
)
def test_other_files_are_refused(tmp_path, content, message):
    path = tmp_path / "b.dhcal.zip"
    if content is not None:
        path.write_bytes(content)
    with pytest.raises(FileFormatError, match=message):
        read_bundle(path)
