"""The console's pages Clients, Access and Health in a real Chromium."""

from __future__ import annotations

import io
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

import psutil
import pytest
from appliance_process import ROBOT, ApplianceProcess
from cryptography import x509
from cryptography.hazmat.primitives import hashes
from cryptography.hazmat.primitives.asymmetric import ec
from cryptography.hazmat.primitives.serialization import (
    Encoding,
    NoEncryption,
    PrivateFormat,
    pkcs12,
)
from cryptography.x509.oid import NameOID
from interop.paho_peer import V5, Peer
from visits import DESKTOP, PHONE, Visit
from waiting import PATIENCE, eventually

pytest.importorskip("playwright.sync_api")

VIEWER = "only-to-look-at-1"
ADMINISTRATIVE_ACTION = 0x98
HOSTILE = "<img src=x onerror=alert(1)>\u202edrawkcab"
LINE = "topic write $CONTROL/appliance/v1/{}/_call"


@pytest.fixture(scope="module")
def appliance(tmp_path_factory: pytest.TempPathFactory) -> Iterator[ApplianceProcess]:
    """As `appliance init` sets it up, without ROS: alice is an admin, viewer a viewer."""
    bind = "127.0.0.1:0"
    web = {"bind": bind, "protocol": "web"}
    listeners = [{"bind": bind, "tls": True}, {"bind": bind}, {**web, "tls": True}, web]
    limits = {"client_id_length": 65_535}
    process = ApplianceProcess(
        tmp_path_factory.mktemp("console"),
        users={"viewer": VIEWER},
        broker={"listeners": listeners, "audit": {"path": "audit.log"}, "limits": limits},
    )
    with (process.directory / "acl.conf").open("a") as file:
        file.write("\nuser viewer\ninclude groups/viewers.conf\n")
    process.start()
    yield process
    process.stop()


def test_disconnect_a_client(visit: Callable[..., Visit], appliance: ApplianceProcess) -> None:
    """Journey 8: found, asked, told 0x98; and a session is deleted."""
    with Peer(appliance, V5, "tablet", expiry=600) as tablet:
        tablet.subscribe(f"{ROBOT}/#")
        for kind, options in (("phone", PHONE), ("desktop", DESKTOP)):
            visited = visit(**options)
            page = visited.sign_in(page="Clients")
            page.wait_for_selector("a:has-text('tablet')")
            visited.look(f"{kind}-clients")
        page.fill("input[type=search]", "TABLE")
        page.wait_for_selector("text='1 client'")
        page.click("a:has-text('tablet')")
        page.wait_for_selector(f".filter:text-is('{ROBOT}/#')")
        visited.look("desktop-client")
        page.click("button:has-text('Disconnect …')")
        page.wait_for_selector("dialog[open]")
        page.keyboard.press("Escape")
        page.wait_for_selector("dialog", state="detached")
        page.click("button:has-text('Disconnect …')")
        page.wait_for_selector("dialog button:focus:text-is('Cancel')")
        visited.look("desktop-client-asked")
        page.click("dialog .danger")
        code = tablet.disconnected.get(timeout=PATIENCE)
        assert code.value == ADMINISTRATIVE_ACTION
        page.wait_for_selector("dd:has-text('away, ends in')")
        page.click("button:has-text('Delete its session …')")
        page.click("dialog .danger")
        page.wait_for_selector("text='There is no such client.'")
        page.go_back()
        page.wait_for_selector("text='There is no client of this name now.'")


def test_pages_of_clients(visit: Callable[..., Visit], appliance: ApplianceProcess) -> None:
    """A page has 50; a name of 64 KiB, markup and turned text are text, and cut."""
    names = [*(f"many-{number:02}" for number in range(50)), HOSTILE, "x" * 65_000]
    peers = [Peer(appliance, V5, name).start() for name in names]
    try:
        visited = visit(**PHONE)
        page = visited.sign_in(page="Clients")
        page.wait_for_selector("text='50 clients'")
        page.click("text='Next'")
        page.wait_for_selector("a:has-text('xxx…')")
        visited.look("phone-clients-hostile")
        page.click("a:has-text('xxx…')")
        page.wait_for_selector("button:has-text('Disconnect …')")
        assert len(page.inner_text("#client")) < 2100
        page.go_back()
        page.fill("input[type=search]", "drawkcab")
        page.wait_for_selector("text='1 client'")
        assert page.inner_text("td.main") == HOSTILE.replace("\u202e", "·")
        page.click("td.main a")
        page.click("button:has-text('Disconnect …')")
        page.click("dialog .danger")
        peers[-2].disconnected.get(timeout=PATIENCE)
        page.wait_for_selector("text='There is no client of this name now.'")
    finally:
        for peer in peers:
            peer.stop()


def test_a_viewer_manages_nothing(visit: Callable[..., Visit]) -> None:
    """Controls are disabled, and the page says which line of the ACL is missing."""
    visited = visit(**PHONE)
    page = visited.sign_in("viewer", "Clients")
    page.wait_for_selector(f"code:text-is('{LINE.format('clients')}')")
    page.wait_for_selector(f"code:text-is('{LINE.format('disconnect')}')")
    page.click("nav a:has-text('Access')")
    page.wait_for_selector(f"li code:text-is('{LINE.format('user_add')}')")
    page.click("summary:has-text('Add a user')")
    page.wait_for_selector("fieldset:disabled button:text-is('Add')")
    visited.look("phone-access-viewer")
    page.click("nav a:has-text('Explain')")
    page.wait_for_selector("fieldset:disabled button:text-is('Explain')")
    page.click("nav a:has-text('Certificates')")
    page.wait_for_selector(f"li code:text-is('{LINE.format('certificates')}')")
    page.click("nav a:has-text('Health')")
    page.wait_for_selector("fieldset:disabled button:text-is('Examine')")
    page.click("nav a:has-text('Log')")
    page.wait_for_selector(f"li code:text-is('{LINE.format('log')}')")


def test_users(visit: Callable[..., Visit], appliance: ApplianceProcess) -> None:
    """A user is added, may do what its groups may, gets another password, and is removed."""
    visited = visit(**DESKTOP)
    page = visited.sign_in(page="Access")
    # The list moves what is below it when it comes, also between the two halves of a click.
    page.wait_for_selector("[role=region][aria-label=Users]")
    page.click("summary:has-text('Add a user')")
    add = page.locator("details:has(summary:has-text('Add a user')) form")
    add.locator("input[name=user]").fill("bob <b>")
    add.locator("input[name=password]").fill("first-of-bob")
    add.locator("label:has-text('drivers') input").check()
    visited.look("desktop-access-add")
    add.locator("button").click()
    page.wait_for_selector("text='bob <b> is there.'")
    page.wait_for_selector("tr:has-text('bob <b>') >> text='drivers'")
    appliance.passwords["bob <b>"] = "first-of-bob"
    topic = f"{ROBOT}/cmd_vel"
    bob = Peer(appliance, V5, "bob", user="bob <b>").start()
    assert not bob.publish(topic, "{}").is_failure
    page.click("button[aria-label='Change bob <b>']")
    one = page.locator("section.inspector")
    one.locator("label:has-text('drivers') input").uncheck()
    one.locator("label:has-text('viewers') input").check()
    one.locator("button:text-is('Set groups')").click()
    page.wait_for_selector("text='The groups are changed.'")
    eventually(lambda: bob.publish(topic, "{}").is_failure, "bob may not drive any more")
    visited.look("desktop-access-user")
    one.locator("input[name=password]").fill("second-of-bob")
    one.locator("button:text-is('Change password')").click()
    page.wait_for_selector("text='The password is changed.'")
    appliance.passwords["bob <b>"] = "second-of-bob"
    Peer(appliance, V5, "bob-2", user="bob <b>").start().stop()
    one.locator("button:text-is('Remove …')").click()
    page.click("dialog .danger")
    # Until the answer is there nothing behind the question can be filled in.
    page.wait_for_selector("dialog", state="detached")
    page.wait_for_selector("tr:has-text('bob <b>')", state="detached")
    bob.disconnected.get(timeout=PATIENCE)
    bob.stop()
    add.locator("input[name=user]").fill("viewer")
    add.locator("input[name=password]").fill("x")
    add.locator("button").click()
    page.wait_for_selector(".notice.bad:has-text('there is a user')")


def photographed(page: Any) -> str:
    """What a phone reads from a picture of the screen."""
    zxingcpp = pytest.importorskip("zxingcpp")
    image = pytest.importorskip("PIL.Image")
    codes = zxingcpp.read_barcodes(image.open(io.BytesIO(page.screenshot())))
    assert len(codes) == 1
    return str(codes[0].text)


def begin_enrolment(page: Any, user: str, group: str = "", certificate: bool = False) -> str:
    """The URL in the QR code."""
    page.click("summary:has-text('Enrol a phone')")
    form = page.locator("details:has(summary:has-text('Enrol a phone')) form")
    form.locator("input[name=user]").fill(user)
    if group:
        form.locator(f"label:has-text('{group}') input").check()
    if certificate:
        form.locator("input[name=certificate]").check()
    form.locator("button").click()
    page.wait_for_selector(".code svg")
    page.locator(".code svg").scroll_into_view_if_needed()
    return photographed(page)


@pytest.mark.parametrize("scheme", ["light", "dark"])
def test_enrol_a_phone(
    visit: Callable[..., Visit], origin: str, appliance: ApplianceProcess, scheme: str
) -> None:
    """Journey 8: from the code as photographed to a phone that is signed in; once."""
    user = f"carol {scheme}"
    admin = visit(color_scheme=scheme, **DESKTOP)
    page = admin.sign_in(page="Access")
    page.wait_for_selector("text=/ users$/")
    url = begin_enrolment(page, user, "viewers")
    admin.look(f"desktop-{scheme}-enrol-code")
    assert url.startswith(f"{origin}/#/enrol/")
    visited = visit(color_scheme=scheme, **PHONE)
    phone = visited.page
    phone.goto("about:blank")
    phone.goto(url)
    phone.wait_for_selector(f"strong:has-text('{user}')")
    visited.look(f"phone-{scheme}-enrol")
    assert phone.evaluate("location.hash") == "#/enrol"
    password = phone.input_value("input[name=password]")
    assert len(password) == 19
    phone.click("button:text-is('Set it and sign in')")
    phone.wait_for_selector("a:has-text('To the console')")
    phone.wait_for_selector(f"dd:text-is('{appliance.port}')")
    visited.look(f"phone-{scheme}-enrolled")
    phone.click("a:has-text('To the console')")
    phone.wait_for_selector("h1:text-is('Overview')")
    assert user in phone.inner_text(".user")
    appliance.passwords[user] = password
    Peer(appliance, V5, f"app of {user}", user=user).start().stop()
    late = visit(**PHONE)
    late.page.goto(url)
    late.page.click("button:text-is('Set it and sign in')")
    late.page.wait_for_selector(".notice.bad:has-text('was used')")
    assert [told for told in late.wrong if "403" not in told] == []
    late.wrong.clear()
    assert password not in appliance.log and url.rpartition("#")[2] not in appliance.log


def test_enrol_a_phone_with_a_certificate(
    visit: Callable[..., Visit], appliance: ApplianceProcess, tmp_path: Path
) -> None:
    """An MQTT app shows what is in the file that the page gives, and is the user."""
    admin = visit(**DESKTOP).sign_in(page="Access")
    admin.wait_for_selector("text=/ users$/")
    url = begin_enrolment(admin, "crane", "viewers", certificate=True)
    visited = visit(**PHONE)
    phone = visited.page
    phone.goto(url)
    phone.fill("input[name=password]", "chosen-by-crane")
    phone.click("button:text-is('Set it and sign in')")
    with phone.expect_download() as downloaded:
        phone.click("a:has-text('crane.p12')")
    visited.look("phone-enrolled-certificate")
    assert downloaded.value.suggested_filename == "crane.p12"
    opened = pkcs12.load_pkcs12(downloaded.value.path().read_bytes(), b"chosen-by-crane")
    assert opened.key is not None and opened.cert is not None
    key, certificate = tmp_path / "crane.key", tmp_path / "crane.crt"
    key.write_bytes(opened.key.private_bytes(Encoding.PEM, PrivateFormat.PKCS8, NoEncryption()))
    certificate.write_bytes(opened.cert.certificate.public_bytes(Encoding.PEM))
    appliance.passwords["crane"] = "chosen-by-crane"
    peer = Peer(appliance, V5, "crane's app", user="crane", certificate=(certificate, key))
    peer.start().stop()


def test_another_password_for_who_is_there(
    visit: Callable[..., Visit], appliance: ApplianceProcess
) -> None:
    """Of a user that is there the code sets another password, and the page says so before."""
    page = visit(**DESKTOP).sign_in(page="Access")
    page.click("summary:has-text('Enrol a phone')")
    page.fill("details:has(summary:has-text('Enrol a phone')) input[name=user]", "viewer")
    page.wait_for_selector("text=/^This user is there/")
    page.click("summary:has-text('Enrol a phone')")
    url = begin_enrolment(page, "viewer")
    phone = visit(**PHONE).page
    phone.goto(url)
    phone.fill("input[name=password]", "chosen-by-viewer")
    phone.click("button:text-is('Set it and sign in')")
    phone.click("a:has-text('To the console')")
    appliance.passwords["viewer"] = "chosen-by-viewer"
    Peer(appliance, V5, "app", user="viewer").start().stop()


def test_explain(visit: Callable[..., Visit]) -> None:
    visited = visit(**PHONE)
    page = visited.sign_in(page="Access")
    page.click("nav a:has-text('Explain')")
    page.fill("input[name=user]", "viewer")
    page.fill("input[name=topic]", f"{ROBOT}/cmd_vel")
    page.click("button:text-is('Explain')")
    page.wait_for_selector("dt:has-text('Publish') >> text='refused'")
    page.wait_for_selector("dt:has-text('Receive') >> text='allowed'")
    page.wait_for_selector(f".verdicts code:text-is('topic write {ROBOT}/cmd_vel')")
    assert page.input_value("input[name=user]") == "viewer"
    visited.look("phone-explain")
    page.fill("input[name=topic]", "a/#/b")
    page.click("button:text-is('Explain')")
    page.wait_for_selector(".notice.bad:has-text('bad_request')")


def test_certificates(
    visit: Callable[..., Visit], appliance: ApplianceProcess, tmp_path: Path
) -> None:
    """A request is signed, what comes is saved, and it is revoked."""
    visited = visit(**DESKTOP)
    page = visited.sign_in(page="Access")
    page.click("nav a:has-text('Certificates')")
    page.click("summary:has-text('Sign a request')")
    key = ec.generate_private_key(ec.SECP256R1())
    subject = x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, "tablet")])
    request = x509.CertificateSigningRequestBuilder().subject_name(subject)
    file = tmp_path / "request.pem"
    file.write_bytes(request.sign(key, hashes.SHA256()).public_bytes(Encoding.PEM))
    page.set_input_files("input[type=file]", file)
    page.click("button:text-is('Sign')")
    with page.expect_download() as download:
        page.click("button:text-is('Save tablet.crt')")
    assert download.value.suggested_filename == "tablet.crt"
    saved = tmp_path / "tablet.crt"
    download.value.save_as(saved)
    assert x509.load_pem_x509_certificate(saved.read_bytes()).public_key() == key.public_key()
    visited.look("desktop-certificates")
    page.click("button[aria-label='Revoke tablet']")
    page.click("dialog .danger")
    page.wait_for_selector("tr:has-text('tablet') >> text='revoked'")
    page.fill("textarea", "no request")
    page.click("button:text-is('Sign')")
    page.wait_for_selector(".notice.bad:has-text('rejected')")


@contextmanager
def waiting_doctor(appliance: ApplianceProcess) -> Iterator[None]:
    """The doctor stands still meanwhile: on a quick computer it is over within a second.

    It goes on with the others' priority, where that is allowed: on a busy one it has no time else.
    """
    process = psutil.Process(appliance.pid)
    eventually(process.children, "the doctor")
    children = process.children()
    for child in children:
        child.suspend()
    yield
    for child in children:
        with suppress(psutil.Error):
            child.nice(0)
        child.resume()


def test_health(visit: Callable[..., Visit], appliance: ApplianceProcess) -> None:
    """The doctor, the log with a line that a stranger has caused, and the audit log."""
    for kind, options, scheme in (("phone", PHONE, "dark"), ("desktop", DESKTOP, "light")):
        visited = visit(color_scheme=scheme, **options)
        page = visited.sign_in(page="Health")
        page.click("button:text-is('Examine')")
        with waiting_doctor(appliance):
            page.wait_for_selector(".notice:text-matches('^Examining … [1-9][0-9]* s$')")
        page.wait_for_selector(".findings li:has-text('certificate')")
        visited.look(f"{kind}-doctor")
        appliance.passwords[HOSTILE] = "x"
        with pytest.raises(AssertionError):
            Peer(appliance, V5, HOSTILE, user=HOSTILE).start()
        page.click("nav a:has-text('Log')")
        page.wait_for_selector(".log li.warning:has-text('<img src=x')")
        visited.look(f"{kind}-log")
        page.fill("input[type=search]", "nobody has logged this")
        page.wait_for_selector("text=/^0 of the last/")
        page.click("nav a:has-text('Audit')")
        page.wait_for_selector("td:has-text('refused')")
        assert "\u202e" not in page.inner_text("table")
        visited.look(f"{kind}-audit")


def test_what_the_page_cannot_reach(visit: Callable[..., Visit], appliance: Any) -> None:
    """While the appliance is away a page says so, and goes on by itself."""
    page = visit(**DESKTOP).sign_in(page="Clients")
    page.wait_for_selector("td.main")
    page.evaluate("location.hash = '#/clients/' + '%ff'")
    page.wait_for_selector("td.main")
    page.evaluate("location.hash = '#/access/nothing'")
    page.wait_for_selector("h1:text-is('Access')")
    page.wait_for_selector("[role=status]:text-matches('^[1-9][0-9]* users$')")
