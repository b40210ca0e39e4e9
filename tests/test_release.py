"""The check of a release."""

import shutil
import subprocess
import sys

import pytest
import yaml
from robots import ROOT


@pytest.fixture
def repository(tmp_path):
    """Repository with version 0.2.0 and its section in the changelog."""
    (tmp_path / ".ci").mkdir()
    shutil.copy(ROOT / ".ci" / "release", tmp_path / ".ci" / "release")
    (tmp_path / "pyproject.toml").write_text('[project]\nversion = "0.2.0"\n')
    (tmp_path / "CHANGELOG.md").write_text("# Changes\n\n## Unreleased\n\n## 0.2.0\n\n- News.\n\n## 0.1.0\n")
    (tmp_path / "CITATION.cff").write_text("title: name\nversion: 0.2.0\nlicense: none\n")
    git(tmp_path, "init", "-q")
    commit(tmp_path)
    return tmp_path


def git(folder, *words):
    identity = ("-c", "user.name=test", "-c", "user.email=test@example.com")
    subprocess.run(["git", *identity, *words], cwd=folder, check=True, capture_output=True)


def commit(folder):
    git(folder, "add", "-A")
    git(folder, "commit", "-qm", "state")


def check(folder, tag="v0.2.0"):
    words = [sys.executable, folder / ".ci" / "release", tag]
    run = subprocess.run(words, capture_output=True, text=True)
    return run.returncode, run.stderr


def test_complete_release_passes_before_and_after_the_tag(repository):
    assert check(repository) == (0, "")
    git(repository, "tag", "v0.2.0")
    assert check(repository) == (0, "")


@pytest.mark.parametrize(
    ("file", "old", "new", "message"),
    [
        ("pyproject.toml", "0.2.0", "0.1.9", "version 0.1.9; expected 0.2.0"),
        ("CHANGELOG.md", "## Unreleased\n", "## Unreleased\n\n- More.\n", "changes under 'Unreleased'"),
        ("CITATION.cff", "0.2.0", "0.1.0", "expected the line 'version: 0.2.0'"),
        ("CHANGELOG.md", "## 0.2.0", "## 0.2.1", "the first section is not that of 0.2.0"),
    ],
)
def test_version_and_changelog_must_agree(repository, file, old, new, message):
    path = repository / file
    path.write_text(path.read_text().replace(old, new))
    commit(repository)
    status, err = check(repository)
    assert status == 1
    assert message in err


def test_uncommitted_files_are_refused(repository):
    (repository / "new.py").write_text("")
    assert check(repository) == (1, "git: files are not committed; commit or remove them\n")


def test_tag_of_another_commit_is_refused(repository):
    git(repository, "tag", "v0.2.0")
    (repository / "new.py").write_text("")
    commit(repository)
    assert check(repository) == (1, "git: the tag v0.2.0 is another commit; choose a new version\n")


@pytest.mark.parametrize("path", sorted((ROOT / ".github").rglob("*.yml")), ids=lambda path: path.name)
def test_workflows_are_valid_yaml(path):
    content = yaml.safe_load(path.read_text(encoding="utf-8"))
    jobs = content.get("jobs", {})
    assert all(job["runs-on"] and job["steps"] for job in jobs.values())
    assert all(
        set(job.get("needs", [])) <= set(jobs) for job in jobs.values() if isinstance(job.get("needs"), list)
    )
