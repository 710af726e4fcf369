"""An authority of the appliance's own, with a server's certificate and a client's."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest
from authorities import ADDRESSES, NAMES

from appliance import certs


@pytest.fixture(scope="session")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A directory with an authority, a server's certificate and a client's; nobody changes it."""
    directory = tmp_path_factory.mktemp("appliance") / "certs"
    names, addresses = certs.local_names()  # with which the certificate renews itself
    certs.create_authority(directory, "r2d2", [*NAMES, *names], [*ADDRESSES, *addresses])
    certs.issue_server(directory, NAMES, ADDRESSES)
    certs.issue_client(directory, "tablet")
    return directory


@pytest.fixture
def own(made: Path, tmp_path: Path) -> Path:
    """A copy of it to change."""
    return Path(shutil.copytree(made, tmp_path / "certs"))
