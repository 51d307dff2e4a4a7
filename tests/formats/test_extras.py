"""A missing extra is one line that says what needs it and how it is installed."""

import sys
import tomllib

import pytest
from shared import ROOT

from chebsplat.errors import ConfigError, InputError
from chebsplat.formats.extras import EXTRAS, extra, require


def test_every_extra_that_can_be_missed_is_one_of_pyproject():
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    assert set(EXTRAS.values()) == project["optional-dependencies"].keys() - {"cuda"}


@pytest.mark.parametrize("package", EXTRAS)
def test_a_missing_package_is_named_by_its_extra(package, monkeypatch):
    monkeypatch.setitem(sys.modules, package, None)
    name = EXTRAS[package]
    message = (
        rf"^this needs the extra `{name}`: \.venv/bin/pip install -e '\.\[{name}\]' installs it"
    )
    with pytest.raises(ConfigError, match=f"{message}; or that$"):
        require(package, "this", "that")
    with pytest.raises(InputError, match=f"{message}$"):
        extra(package, "this", error=InputError)


def test_a_package_whose_library_is_missing_says_which(tmp_path, monkeypatch):
    (tmp_path / "pymeshlab.py").write_text("raise ImportError('libGL.so.1: no such file')")
    monkeypatch.syspath_prepend(str(tmp_path))
    monkeypatch.delitem(sys.modules, "pymeshlab", raising=False)
    with pytest.raises(ConfigError, match=r"^this \(libGL.so.1: no such file\) needs the extra"):
        extra("pymeshlab", "this")
