"""Users, groups and certificates are changed by calls, and are in force with the answer."""

from __future__ import annotations

from pathlib import Path

import pytest
from cryptography import x509
from cryptography.hazmat.primitives import hashes
from cryptography.hazmat.primitives.asymmetric import ec
from cryptography.hazmat.primitives.serialization import Encoding
from cryptography.x509.oid import NameOID
from waiting import until

from appliance import certs
from appliance.mqtt.packets import Disconnect
from appliance.mqtt.reason import ReasonCode
from management.managed import BOTH, PASSWORD, CallError, Site


@pytest.mark.parametrize("version", BOTH)
async def test_users(site: Site, version: int):
    folder = site.directory / "groups"
    folder.mkdir()
    (folder / "viewers.conf").write_text("topic read r2d2/#\n")
    (folder / "drivers.conf").write_text("include viewers.conf\ntopic write r2d2/cmd_vel\n")
    admin = await site.join("a", version=version)
    new = {"user": "bob", "password": PASSWORD, "groups": ["drivers"]}
    assert await admin.call("user_add", new) == {"user": "bob"}
    bob = await site.join("b", "bob")
    listed = await admin.call("users")
    assert listed["groups"] == ["drivers", "viewers"]
    assert listed["users"][1] == {"user": "bob", "kind": "argon2id", "groups": ["drivers"]}
    drive = {"user": "bob", "topic": "r2d2/cmd_vel"}

    async def may_drive() -> bool:
        verdicts = (await admin.call("explain", drive))["verdicts"]
        return any(each["allowed"] for each in verdicts if each["action"] == "publish")

    assert await may_drive()
    await admin.call("user_groups", {"user": "bob", "groups": ["viewers"]})
    assert not await may_drive()
    changed = {"user": "bob", "password": "another", "scram": True}
    await admin.call("user_password", changed)
    with pytest.raises(AssertionError):
        await site.join("b2", "bob")
    await admin.call("user_remove", {"user": "bob"})
    assert (await bob.wait_for(Disconnect)).reason_code == ReasonCode.ADMINISTRATIVE_ACTION
    for verb, arguments, code in (
        ("user_add", {"user": "admin", "password": "x"}, "rejected"),
        ("user_add", {"user": "a:b", "password": "x"}, "bad_request"),
        ("user_add", {"user": "c", "password": "x", "groups": ["../x"]}, "bad_request"),
        ("user_add", {"user": "c", "password": ""}, "bad_request"),
        ("user_remove", {"user": "bob"}, "not_found"),
        ("user_groups", {"user": "bob", "groups": []}, "not_found"),
    ):
        with pytest.raises(CallError) as refused:
            await admin.call(verb, arguments)
        assert refused.value.code == code, (verb, str(refused.value))
    await until(lambda: len(site.audited()) >= 10, "the audit log")
    text = (site.directory / "audit.log").read_text()
    assert '"user added"' in text and '"user removed"' in text
    assert PASSWORD not in text and "another" not in text
    assert "c" not in {each["user"] for each in (await admin.call("users"))["users"]}


async def test_certificates(tmp_path: Path):
    site = Site(tmp_path, tls=True)
    await site.app.start()
    try:
        admin = await site.join("a")
        key = ec.generate_private_key(ec.SECP256R1())
        name = x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, "phone")])
        builder = x509.CertificateSigningRequestBuilder().subject_name(name)
        request = builder.sign(key, hashes.SHA256()).public_bytes(Encoding.PEM).decode()
        made = await admin.call("certificate_sign", {"request": request})
        own = x509.load_pem_x509_certificate(made["certificate"].encode())
        authority = x509.load_pem_x509_certificate(made["ca"].encode())
        own.verify_directly_issued_by(authority)
        assert made["name"] == "phone" and own.public_key() == key.public_key()
        listed = (await admin.call("certificates"))["certificates"]
        assert {each["name"] for each in listed} >= {"ca", "phone"}
        server = next(each for each in listed if each["for"] == "server")
        assert await admin.call("certificate_revoke", {"certificate": "phone"}) == {
            "revoked": ["phone"]
        }
        for verb, arguments, code in (
            ("certificate_revoke", {"certificate": server["name"]}, "rejected"),
            ("certificate_revoke", {"certificate": server["serial"]}, "rejected"),
            ("certificate_revoke", {"certificate": "certs/clients/phone.crt"}, "not_found"),
            ("certificate_revoke", {"certificate": "phone"}, "rejected"),
            ("certificate_sign", {"request": "x"}, "rejected"),
            ("certificate_sign", {"request": request, "name": "../x"}, "rejected"),
        ):
            with pytest.raises(CallError) as refused:
                await admin.call(verb, arguments)
            assert refused.value.code == code, (verb, arguments, str(refused.value))
        states = {each.name: each.state for each in certs.list_certificates(tmp_path / "certs")}
        assert states["phone"] == "revoked"
    finally:
        await site.stop()


async def test_a_removed_user_is_in_no_group(site: Site):
    """A client certificate may name the user still: what it may do then are its own rules."""
    folder = site.directory / "groups"
    folder.mkdir()
    (folder / "drivers.conf").write_text("topic write r2d2/cmd_vel\n")
    admin = await site.join("a")
    await admin.call("user_add", {"user": "bob", "password": PASSWORD, "groups": ["drivers"]})
    drive = {"user": "bob", "topic": "r2d2/cmd_vel"}
    assert any(each["allowed"] for each in (await admin.call("explain", drive))["verdicts"])
    await admin.call("user_remove", {"user": "bob"})
    assert not any(each["allowed"] for each in (await admin.call("explain", drive))["verdicts"])
