import re
import shutil
import subprocess

from mambaloc import provenance


def test_commit_is_a_hash_or_none():
    commit = provenance.commit()
    assert commit is None or re.fullmatch(r"[0-9a-f]{40}(\+changes)?", commit)


def test_an_installation_inside_another_projects_checkout_has_no_commit(tmp_path, monkeypatch):
    """Guess: `git rev-parse HEAD` in an untracked folder answers with the surrounding repository's commit."""
    git = ["git", "-C", str(tmp_path), "-c", "user.name=a", "-c", "user.email=a@example.org"]
    subprocess.run([*git, "init", "-q"], check=True)
    subprocess.run([*git, "commit", "-q", "--allow-empty", "-m", "theirs"], check=True)
    installed = tmp_path / ".venv/mambaloc"
    installed.mkdir(parents=True)
    shutil.copy(provenance.__file__, installed)
    monkeypatch.setattr(provenance, "__file__", str(installed / "provenance.py"))
    assert provenance.commit() is None
    subprocess.run([*git, "add", "."], check=True)
    assert re.fullmatch(r"[0-9a-f]{40}\+changes", provenance.commit())


def test_versions_name_what_a_number_depends_on():
    versions = provenance.versions()
    assert {"python", "torch", "timm", "mambaloc"} <= versions.keys()
    assert "unknown" not in versions.values()


def test_device_name_says_how_many_threads():
    assert provenance.device_name().endswith("threads")
