"""What the tests of several listeners have in common."""

from __future__ import annotations

import ssl

import pytest
from harness import make_contexts


@pytest.fixture(scope="module")
def contexts(tmp_path_factory: pytest.TempPathFactory) -> tuple[ssl.SSLContext, ssl.SSLContext]:
    """The server's and the client's settings for TLS."""
    return make_contexts(tmp_path_factory.mktemp("certs") / "certs")
