"""`certs/README.md`: what the files are, and how clients get theirs."""

from __future__ import annotations

from datetime import timedelta
from pathlib import Path
from typing import Final

from appliance.certs.files import make_directory, write

_README: Final = """\
# Keys and certificates of this appliance

Made on this computer. None of it belongs into a repository, a chat or a ticket, except `ca.crt`.

- `ca.crt`: the certificate of this appliance's own authority, by which clients know the robot.
  **Everyone** may have it, and every client needs it. It may sign for private names and addresses,
  and those that this computer had when it was made; not for other sites.
- `ca.key`: its key. Whoever has it can pose as the robot, and as any client. **Nobody** gets it.
  It is only needed to make and revoke certificates: you may keep it elsewhere until then
  (`--ca-key FILE`). The server's certificate then does not renew itself.
- `server.crt`: the server's certificate, with the names and addresses of this computer. Clients
  get it when they connect.
- `server.key`: its key, for **the appliance alone**.
- `clients/NAME.crt`, `clients/NAME.key`: a client's certificate and key, for **that client alone**;
  as `NAME.p12` for phones, as `NAME.pem` in one file with `ca.crt`.
- `ca.crl`: the certificates that were revoked. Everyone may have it.
- `issued.jsonl`: what was issued, by which a lost device's certificate is revoked. Keep it.

The appliance refuses a key file that others can read: `chmod 600 FILE`.

The authority is valid for ten years, the others for {days} days. The running appliance makes the
server's certificate anew before it ends, and when this computer gets another name or address. The
key stays, and clients keep their `ca.crt`. `appliance cert list` shows what is there and how long
it is valid, `appliance cert renew NAME` makes a client's anew.

## Giving `ca.crt` to clients

Check that it arrived as it left: `openssl x509 -in ca.crt -noout -fingerprint -sha256` prints the
same on both sides.

- **mosquitto_sub, mosquitto_pub**: `--cafile ca.crt`. **paho-mqtt**: `client.tls_set("ca.crt")`.
  **MQTT.js**: `ca: fs.readFileSync("ca.crt")`.
- **Android**: Settings → Security → Encryption & credentials → Install a certificate → CA
  certificate. **iPhone, iPad**: open the file, install the profile in Settings, then turn it on
  under General → About → Certificate Trust Settings. MQTT apps often take the file themselves.
- **A browser**: import it as an authority for websites. **Debian, Ubuntu**: copy it to
  `/usr/local/share/ca-certificates/` and run `update-ca-certificates`.
- **A microcontroller**: paste the file into the program: `client.setCACert(ca)` on Arduino-ESP32,
  `.broker.verification.certificate` in ESP-IDF, `mbedtls_x509_crt_parse` (its length counts the
  closing zero byte). It needs ECDSA and P-256, and the time of day, which is what NTP is for.

Clients connect to a name or address that is in the certificate; to see which:
`openssl x509 -in server.crt -noout -ext subjectAltName`. A name such as `robot.local` stays right
when the address changes.

## Certificates for clients

`appliance cert issue NAME` makes key and certificate of a client; with `--pkcs12` also one file
with a password, as phones take it, with `--bundle` one with key, certificate and `ca.crt`, as
microcontrollers do. Better still, the key never leaves the device: it makes a request, and
`appliance cert sign FILE` a certificate of that.

A device is lost: `appliance cert revoke NAME`. In force when the appliance reloads, also for
connections that are open; the device's files are not needed for that.
"""


def write_readme(directory: Path, valid: timedelta) -> None:
    """Writes `README.md`; `valid` is how long certificates are."""
    make_directory(directory)
    write(directory / "README.md", _README.format(days=valid.days).encode(), 0o644)
