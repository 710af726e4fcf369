"""What a real Chromium makes of the constraints of our authority, once it is installed there."""

from __future__ import annotations

import ipaddress
import shutil
import ssl
import subprocess
import threading
from collections.abc import Iterator
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path

import pytest
from authorities import Company
from cryptography import x509
from waiting import PATIENCE

from appliance import certs
from appliance.certs import load_key

CHROMIUM = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "chrome"))), None)
CERTUTIL = shutil.which("certutil")

pytestmark = [
    pytest.mark.skipif(CHROMIUM is None, reason="Chromium is not installed"),
    pytest.mark.skipif(CERTUTIL is None, reason="certutil is not installed (libnss3-tools)"),
]


class Hello(BaseHTTPRequestHandler):
    def do_GET(self) -> None:
        self.send_response(200)
        self.end_headers()
        self.wfile.write(b"<p>the robot is here</p>")

    def log_message(self, *_: object) -> None:
        """Nothing."""


@pytest.fixture(scope="module")
def home(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Of a user who trusts the authority in `certs`, which was made for r2d2.acme.example, too."""
    home = tmp_path_factory.mktemp("home")
    certs.create_authority(home / "certs", "r2d2", ["r2d2.acme.example"])
    database = home / ".pki/nssdb"
    database.mkdir(parents=True)
    where = ["-d", f"sql:{database}"]
    assert CERTUTIL is not None
    subprocess.run([CERTUTIL, "-N", "--empty-password", *where], check=True, timeout=PATIENCE)
    add = ["-A", "-n", "robot", "-t", "C,,", "-i", home / "certs/ca.crt"]
    subprocess.run([CERTUTIL, *add, *where], check=True, timeout=PATIENCE)
    return home


@pytest.fixture
def server(home: Path, request: pytest.FixtureRequest) -> Iterator[ThreadingHTTPServer]:
    """An HTTPS server for that name, whose certificate the authority's key has signed."""
    company = Company()
    company.key = load_key(home / "certs/ca.key")  # type: ignore[assignment]
    [company.certificate] = certs.load_certificates(home / "certs/ca.crt")
    try:
        name: x509.GeneralName = x509.IPAddress(ipaddress.ip_address(request.param))
    except ValueError:
        name = x509.DNSName(request.param)
    company.issue(home / "server", "server", server=True, alternatives=[name])
    context = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
    context.load_cert_chain(home / "server.crt", home / "server.key")
    server = ThreadingHTTPServer(("127.0.0.1", 0), Hello)
    server.socket = context.wrap_socket(server.socket, server_side=True)
    thread = threading.Thread(target=server.serve_forever)
    thread.start()
    yield server
    server.shutdown()
    thread.join(PATIENCE)
    server.server_close()


def page(home: Path, name: str, port: int) -> str:
    """What the browser shows under that name, which leads to this computer, and what it logs."""
    assert CHROMIUM is not None
    options = ["--headless", "--no-sandbox", "--disable-gpu", "--disable-dev-shm-usage"]
    options += ["--enable-logging=stderr", "--log-level=0"]
    rule = f"--host-resolver-rules=MAP * 127.0.0.1:{port}"
    found = subprocess.run(
        [CHROMIUM, *options, rule, f"--user-data-dir={home}/profile", "--dump-dom", name],
        env={"HOME": str(home), "PATH": "/usr/bin:/bin"},
        capture_output=True,
        text=True,
        errors="replace",
        timeout=2 * PATIENCE,
    )
    return found.stdout + found.stderr


@pytest.mark.parametrize(
    ("server", "may"),
    [
        ("robot.local", True),
        ("r2d2.acme.example", True),
        ("10.1.2.3", True),
        ("www.example.com", False),
        ("8.8.8.8", False),
    ],
    indirect=["server"],
)
@pytest.mark.timeout(300)
def test_sites_of_the_world_are_not_the_robots(
    home: Path, server: ThreadingHTTPServer, may: bool, request: pytest.FixtureRequest
) -> None:
    name = request.node.callspec.params["server"]
    shown = page(home, f"https://{name}/", server.server_port)
    assert ("the robot is here" in shown) is may, shown[:2000]
    assert may or "net_error -207" in shown, shown  # ERR_CERT_INVALID
