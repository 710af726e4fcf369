"""The order in which a login is decided.

The first of these that applies decides about a CONNECT:

1. **The client's certificate**, where `broker.tls.username_from` takes the user from it: no
   password is asked for, and a CONNECT that names another user is refused.
2. **A token** (`tokens.py`) in the place of the password. The user name may be left out.
3. **The users file**, for a user that has a line in it; without plugins that authenticate,
   for every user.
4. **Anonymous access**, for a client without a user name, as `broker.anonymous` or the client's
   listener says. A listener that says no has the last word, plugins or not.
5. **amqtt's plugins**, where some that authenticate are configured.

At a listener whose clients are always anonymous, steps 3 to 5 are left out, and a user name with
its password means nothing.

SCRAM (enhanced authentication) is step 3 with a proof in the place of the password. It is not
offered where step 1 has decided already, nor beside plugins that authenticate: it would bypass
those that refuse the client.
"""

from __future__ import annotations

import ssl
from collections.abc import Callable
from typing import Protocol

from appliance.access.files import FileAccess
from appliance.access.tokens import is_token
from appliance.broker.limits import Anonymous
from appliance.broker.ports import Exchange
from appliance.broker.values import Identity, Refusal
from appliance.mqtt.codec import quote
from appliance.mqtt.packets import Connect
from appliance.mqtt.reason import ReasonCode


class LoginPlugins(Protocol):
    """Plugins as far as a login is concerned; there are none where none is configured."""

    @property
    def authenticates(self) -> bool:
        """Whether one of them authenticates clients; others only observe, or rule topics."""

    def connect_received(self, connect: Connect) -> None:
        """Notify them of a CONNECT, before anything is decided."""

    async def authenticate(
        self, connect: Connect, address: str, tls: ssl.SSLObject | None
    ) -> tuple[Identity | Refusal, object]:
        """Who the client is by what they say, and what they noted meanwhile, for `admitted`."""

    def admitted(
        self,
        identity: Identity,
        connect: Connect,
        address: str,
        tls: ssl.SSLObject | None,
        noted: object,
    ) -> None:
        """The client is admitted; `noted` is None when the plugins were not asked."""


def no_user(tls: ssl.SSLObject) -> str | None:
    """No certificate names a user."""
    return None


class LoginPolicy:
    """Decides who a client is; see the module for the order.

    `certificate_user` is the user that a client's certificate names, None for none; its ValueError
    refuses the client.
    """

    def __init__(
        self,
        files: FileAccess,
        certificate_user: Callable[[ssl.SSLObject], str | None] = no_user,
        plugins: LoginPlugins | None = None,
    ) -> None:
        self._files = files
        self._certificate_user = certificate_user
        self._plugins = plugins

    async def authenticate(
        self,
        connect: Connect,
        address: str,
        tls: ssl.SSLObject | None = None,
        anonymous: Anonymous = None,
    ) -> Identity | Refusal:
        """Who sent the CONNECT, or why it is refused.

        `anonymous` is whether its listener admits clients without a user name, None where it does
        not say.
        """
        plugins = self._plugins
        if plugins is not None:
            plugins.connect_received(connect)
        who, noted = await self._decide(connect, address, tls, anonymous)
        if plugins is not None and isinstance(who, Identity):
            plugins.admitted(who, connect, address, tls, noted)
        return who

    async def identify(
        self,
        username: str | None,
        password: bytes | None,
        address: str,
        tls: ssl.SSLObject | None = None,
        anonymous: Anonymous = None,
    ) -> Identity | Refusal:
        """Who somebody is that does not speak MQTT: decided as a CONNECT without a client id.

        Plugins that only watch are not told: for them a login is the beginning of a session.
        """
        connect = Connect("", username=username, password=password)
        who, _ = await self._decide(connect, address, tls, anonymous)
        return who

    async def _decide(
        self, connect: Connect, address: str, tls: ssl.SSLObject | None, anonymous: Anonymous
    ) -> tuple[Identity | Refusal, object]:
        try:
            owner = self._certificate_user(tls) if tls is not None else None
        except ValueError as error:
            return Refusal(ReasonCode.NOT_AUTHORIZED, str(error)), None
        if owner is not None:
            return _by_certificate(owner, connect), None
        plugins, files, username = self._plugins, self._files, connect.username
        if connect.password is not None and is_token(connect.password):
            return files.by_token(username, connect.password, connect.client_id), None
        if anonymous == "always":
            return Identity(None, connect.client_id), None
        is_known = plugins is None or not plugins.authenticates or files.knows(username)
        if is_known or username is None:
            who = await files.authenticate(
                username, connect.password, connect.client_id, address, anonymous
            )
            if is_known or anonymous is False or isinstance(who, Identity):
                return who, None
        assert plugins is not None
        who, noted = await plugins.authenticate(connect, address, tls)
        if anonymous is False and isinstance(who, Identity) and who.username is None:
            reason = "no plugin knows the user, nor do the files"
            return Refusal(ReasonCode.NOT_AUTHORIZED, reason), None
        return who, noted

    def exchange(
        self, method: str, address: str, tls: ssl.SSLObject | None, again: str | None = None
    ) -> Exchange | None:
        """Begin an enhanced authentication; None when the method is not offered to this client.

        `again` is the user of a client that has logged in and authenticates again.
        """
        if self._plugins is not None and self._plugins.authenticates:
            return None
        if tls is not None:
            try:
                if self._certificate_user(tls) is not None:
                    return None
            except ValueError:
                return None
        return self._files.exchange(method, address, again)


def _by_certificate(owner: str, connect: Connect) -> Identity | Refusal:
    if connect.username not in (None, "", owner):
        # Of two names nobody can tell whose rights are meant.
        reason = f"its certificate is of user {quote(owner)}, and it says to be another one"
        return Refusal(ReasonCode.NOT_AUTHORIZED, reason)
    return Identity(owner, connect.client_id)
