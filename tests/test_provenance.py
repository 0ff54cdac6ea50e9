import re

from mambaloc import provenance


def test_commit_is_a_hash_or_none():
    commit = provenance.commit()
    assert commit is None or re.fullmatch(r"[0-9a-f]{40}(\+changes)?", commit)


def test_versions_name_what_a_number_depends_on():
    versions = provenance.versions()
    assert {"python", "torch", "timm", "mambaloc"} <= versions.keys()
    assert "unknown" not in versions.values()


def test_device_name_says_how_many_threads():
    assert provenance.device_name().endswith("threads")
