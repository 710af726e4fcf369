"""`certs/README.md`: what the files are, which are secret, and how clients get theirs.

The repository's own `certs/README.md` is this text: there `appliance init` finds it and keeps it,
and a clone stays clean. A test compares the two.
"""

from __future__ import annotations

from datetime import timedelta
from pathlib import Path
from typing import Final

from appliance.certs.files import make_directory, write

_README: Final = """\
# Keys and certificates of this appliance

`appliance init` makes these files on this computer, and keeps those that exist. This page is the
only one of them that belongs in a repository. The secret ones never leave this computer, except a
client's key on its way to that client.

| File | What it is | Secret | Who may have it |
|---|---|---|---|
| `ca.crt` | the certificate of the appliance's own CA; every client needs it | no | everyone |
| `ca.key` | its key: whoever has it can pose as the robot and as any client | **yes** | nobody |
| `server.crt` | the server's certificate, for this computer's names and addresses | no | everyone |
| `server.key` | its key | **yes** | the appliance alone |
| `clients/NAME.crt` | a client's certificate | no | that client |
| `clients/NAME.key` | its key; also in `NAME.p12` and `NAME.pem` | **yes** | that client |
| `ca.crl` | the certificates that were revoked | no | everyone |
| `issued.jsonl` | what was issued; `appliance cert revoke` needs it | no | this computer |

The CA may sign for private names and addresses, and for those that this computer had when the CA
was made; not for other sites. `ca.key` is needed only to issue and revoke certificates, so you may
keep it elsewhere until then (`--ca-key FILE`). The server's certificate then does not renew itself.

The appliance refuses a key file that others can read: `chmod 600 FILE`.

The CA is valid for ten years, the other certificates for {days} days. The running appliance renews
the server's certificate before it expires, and when this computer gets another name or address. The
key stays, and clients keep their `ca.crt`. `appliance cert list` shows what there is and how long
it is valid, `appliance cert renew NAME` renews a client's.

## Giving `ca.crt` to clients

Compare the fingerprints on both sides: `appliance cert fingerprint` here, and there
`openssl x509 -in ca.crt -noout -fingerprint -sha256`.

- **mosquitto_sub, mosquitto_pub**: `--cafile ca.crt`. **paho-mqtt**: `client.tls_set("ca.crt")`.
  **MQTT.js**: `ca: fs.readFileSync("ca.crt")`.
- **Android**: Settings → Security → Encryption & credentials → Install a certificate → CA
  certificate. **iPhone, iPad**: open the file, install the profile in Settings, then turn it on
  under General → About → Certificate Trust Settings. MQTT apps often take the file themselves.
- **A browser**: import it as an authority for websites. **Debian, Ubuntu**: copy it to
  `/usr/local/share/ca-certificates/` and run `update-ca-certificates`.
- **A microcontroller**: paste the file into the program: `client.setCACert(ca)` on Arduino-ESP32,
  `.broker.verification.certificate` in ESP-IDF, `mbedtls_x509_crt_parse` (its length includes the
  terminating zero byte). It needs ECDSA with P-256, and the time of day, for example by NTP.

Clients connect to a name or address that is in the certificate. This shows them:
`openssl x509 -in server.crt -noout -ext subjectAltName`. A name such as `robot.local` stays valid
when the address changes.

## Certificates for clients

`appliance cert issue NAME` makes the key and the certificate of a client. With `--pkcs12` it also
makes one file with a password, which phones import; with `--bundle` one file with key, certificate
and `ca.crt`, for microcontrollers. It is safer when the key never leaves the device: the device
makes a request, and `appliance cert sign FILE` makes a certificate of it.

If a device is lost: `appliance cert revoke NAME`. It takes effect when the appliance reloads, for
open connections as well. The device's files are not needed.
"""


def write_readme(directory: Path, valid: timedelta) -> None:
    """Write `README.md`; `valid` is how long certificates are valid."""
    make_directory(directory)
    write(directory / "README.md", _README.format(days=valid.days).encode(), 0o644)
