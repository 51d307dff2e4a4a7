"""Figures of docs/results are of the default recipe as it is, or stand under "Earlier recipes"."""

import hashlib
import json
import re
import subprocess
from datetime import UTC, datetime

import pytest
from shared import ROOT

from chebsplat.stages.runtime.config import Config
from chebsplat.stages.training.defaults import DEFAULTS

PAGES = sorted((ROOT / "docs/results").glob("*.md"))
AT = r"`([0-9a-f]{7,40})` \((\d{4}-\d\d-\d\d \d\d:\d\d)\)"  # a commit and its date, UTC
EARLIER = "## Earlier recipes"
FIGURE = re.compile(r"\d (?:%|dB|points|s)\b|\d %|^\|.*\d", re.MULTILINE)


def git(*arguments):
    return subprocess.run(["git", "-C", ROOT, *arguments], capture_output=True, text=True)


def known(commit):
    """Whether this is a whole clone with the commit in it."""
    whole = git("rev-parse", "--is-shallow-repository").stdout.strip() == "false"
    return whole and git("cat-file", "-e", f"{commit}^{{commit}}").returncode == 0


def dated(commit):
    """When a commit was made, UTC, to the minute."""
    seconds = int(git("log", "-1", "--format=%ct", commit).stdout)
    return f"{datetime.fromtimestamp(seconds, UTC):%Y-%m-%d %H:%M}"


def recipe():
    """(commit, date, digest of the defaults) that the first page gives."""
    text = (ROOT / "docs/results/README.md").read_text()
    return re.search(f"The default recipe last changed at {AT}; .* digest `(\\w+)`", text).groups()


def sections(page):
    """Title and text of each section of a page, those of earlier recipes left out."""
    parts = re.split(r"^(?=## )", page.read_text().split(EARLIER)[0], flags=re.MULTILINE)
    return [(part.partition("\n")[0], part) for part in parts]


def test_the_digest_in_docs_is_that_of_every_default_and_rule():
    """Where this fails, a default has changed: figures of the one before move under "Earlier
    recipes", unless they are as they were; commit, date and digest follow.
    """
    held = (
        Config().model_dump(mode="json"),
        {name: default.by for name, default in DEFAULTS.items()},
    )
    digest = hashlib.sha256(json.dumps(held, sort_keys=True).encode()).hexdigest()[:12]
    assert recipe()[2] == digest


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.stem)
def test_figures_outside_earlier_recipes_are_not_older_than_the_default(page):
    changed, since, _ = recipe()
    for title, text in sections(page):
        made = re.findall(f"Made at {AT}", text)
        assert made or not FIGURE.search(text), (
            f"{title}: say by which commit its figures were made"
        )
        for commit, date in made:
            assert date >= since, title
            if known(commit) and known(changed):
                assert (dated(changed), dated(commit)) == (since, date), title
                assert git("merge-base", "--is-ancestor", changed, commit).returncode == 0, title


def test_what_stands_under_earlier_recipes_says_of_which_commits_it_is():
    earlier = [page.read_text().split(EARLIER)[1] for page in PAGES if EARLIER in page.read_text()]
    assert earlier
    for text in earlier:
        first = text.strip().split("\n\n")[0]
        assert re.search(r"\b[0-9a-f]{7}\b.*\(\d{4}-\d\d-\d\d", first, re.DOTALL), first
