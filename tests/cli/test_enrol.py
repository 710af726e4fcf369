"""`appliance user enrol`: a code in the terminal, here and from afar."""

from __future__ import annotations

import asyncio
import re
from pathlib import Path

import pytest
from command_line import run
from management.managed import PASSWORD, Site


async def test_a_code_in_the_terminal(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    site = Site(tmp_path, tls=True)
    await site.app.start()
    monkeypatch.setenv("APPLIANCE_PASSWORD", PASSWORD)
    here = ("--config", str(site.file))
    port = str(site.app.addresses[1][1])
    afar = ("--host", "localhost", "--port", port, "--ca", str(tmp_path / "certs/ca.crt"), *here)

    async def told(*arguments: str) -> tuple[int, str]:
        code = await asyncio.to_thread(run, "user", "enrol", *arguments)
        shown = capsys.readouterr()
        return code, shown.out + shown.err

    try:
        code, text = await told("viewer", "--origin", "https://robot:8443", *here)
        *picture, url, words = text.splitlines()
        assert code == 0 and words.startswith("Once, within 10 minutes")
        found = re.fullmatch(r"https://robot:8443/#/enrol/([\w-]{32})/viewer", url)
        assert found is not None and len(picture) > 15
        assert max(map(len, picture)) < 80
        taken = site.app._enrolments.take(found[1])
        assert taken is not None and taken.username == "viewer" and taken.by is None
        code, text = await told("new", "--new", "--user", "admin", *afar)
        assert code == 0 and "https://localhost:8443/#/enrol/" in text
        code, text = await told("crane", "--new", "--certificate", "--user", "admin", *afar)
        found = re.search(r"/enrol/([\w-]{32})/crane", text)
        assert code == 0 and found is not None
        taken = site.app._enrolments.take(found[1])
        assert taken is not None and taken.with_certificate and taken.groups == ()
        code, text = await told("viewer", "--user", "viewer", *afar)
        assert code == 1 and "topic write $CONTROL/appliance/v1/enrol/_call/#" in text
        assert (await told("nobody", "--origin", "https://robot", *here))[0] == 1
        code, text = await told("viewer", *here)
        assert code == 1 and "Say --origin" in text  # there is no listener for the web
        assert (await told("viewer", "--group", "viewers", *here))[0] == 2
    finally:
        await site.stop()
