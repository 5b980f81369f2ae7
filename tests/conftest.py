"""Fixtures that several test files share."""

import os
from pathlib import Path

import pytest
from hypothesis import settings

# A busy machine is slow, not wrong. Examples are the same in every run: what is red stays red.
settings.register_profile("tog_drake", deadline=None, derandomize=True)
settings.load_profile("tog_drake")


@pytest.fixture(scope="session")
def shared_data() -> Path:
    """The folder of recorded views and scanned objects, which is not part of this repository."""
    beside = Path(__file__).resolve().parents[2] / "shared" / "data"
    folder = Path(os.environ.get("TOG_SHARED_DATA", beside))
    if not folder.is_dir():
        pytest.skip(f"no recorded data at {folder}; set TOG_SHARED_DATA to the folder that has it")
    return folder


@pytest.fixture(scope="session")
def parity() -> Path:
    """The folder of recorded inputs and outputs, which is not part of this repository."""
    beside = Path(__file__).resolve().parents[2] / "shared" / "cgn_parity"
    folder = Path(os.environ.get("TOG_CGN_PARITY", beside))
    if not folder.is_dir():
        pytest.skip(f"no parity fixture at {folder}; set TOG_CGN_PARITY to the folder that has it")
    return folder
