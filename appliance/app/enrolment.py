"""`POST /enrol`: a phone's one-time code becomes its user's password, see `access/enrolments.py`.

Code and new password come as HTTP's Basic authentication: the form of a request without a body, and
nothing that another site's page could have a browser send. Wrong codes are throttled as wrong
passwords are, and noted with them.
"""

from __future__ import annotations

import asyncio
import base64
import json
from collections.abc import Callable
from dataclasses import dataclass
from typing import Final

from appliance.access import FileAccess
from appliance.access.enrolments import Enrolments
from appliance.broker.broker import Broker
from appliance.broker.values import Refusal
from appliance.management.enrolment import LONGEST_ENROLMENT, carry_out
from appliance.management.phone_certificates import PhoneCertificates
from appliance.management.verbs import Verbs
from appliance.mqtt.reason import ReasonCode
from appliance.net.http import RETRY_AFTER, HttpRequest, HttpResponse, text
from appliance.ros.calls.dispatcher import CallError
from appliance.web.authority import is_local
from appliance.web.login import WebLogin, credentials
from appliance.web.site import Resource

#: The most seconds that a code waits because of wrong ones from its address.
MAX_WAIT: Final = 5.0

#: The throttle's queue of codes: they do not wait behind guesses of passwords, nor these behind
#: them. How long an address waits is the same for both.
_QUEUE: Final = "enrol"

_UNKNOWN: Final = Refusal(ReasonCode.NOT_AUTHORIZED, "unknown enrolment code")
_STATUS: Final = {"bad_request": 400, "not_authorized": 403, "too_many": 503}


@dataclass(frozen=True, slots=True)
class EnrolmentParts:
    """What the resource is about; `verbs` are None until management has begun, and `mqtt_port` is
    that of MQTT over TLS, None where there is none."""

    broker: Broker
    access: FileAccess
    login: WebLogin
    enrolments: Enrolments
    phones: PhoneCertificates
    verbs: Callable[[], Verbs | None]
    mqtt_port: Callable[[], int | None]


def enrol(parts: EnrolmentParts) -> Resource:
    """Takes codes, each once."""

    async def respond(request: HttpRequest) -> HttpResponse:
        if request.tls is None and not is_local(request.peer):
            return text(403, "ask over TLS: on the way here the password could be read")
        try:
            code, given = credentials(request)
            password = (given or b"").decode()
        except ValueError:
            return text(400, "Basic authentication is needed, of CODE:PASSWORD in UTF-8")
        verbs = parts.verbs()
        if not code or verbs is None:
            return text(400 if verbs is not None else 503, "no code, or too early")
        throttle = parts.access.throttle
        turn = throttle.reserve(request.address, _QUEUE, MAX_WAIT)
        if turn is None:
            return text(503, "too many wrong codes", ("Retry-After", str(RETRY_AFTER)))
        await asyncio.sleep(turn)
        enrolment = parts.enrolments.take(code)
        if enrolment is None:
            throttle.record_failure(request.address, "")
            parts.login.note(request, None, _UNKNOWN)
            return text(403, "this code was used, has ended, or is not of here")
        request.allow(LONGEST_ENROLMENT)
        try:
            done = await carry_out(
                parts.broker, verbs, parts.phones, enrolment, password, request.address
            )
        except CallError as error:
            if error.code == "bad_request":  # the password: another one may be better
                parts.enrolments.put_back(code, enrolment)
            return text(_STATUS.get(error.code, 409), str(error))
        answer = {"user": enrolment.username, "mqtt_port": parts.mqtt_port()}
        if enrolment.with_certificate:
            packed = done.pkcs12
            answer["p12"] = None if packed is None else base64.b64encode(packed).decode()
            answer["problem"] = done.problem
        return HttpResponse(200, json.dumps(answer).encode(), "application/json")

    return Resource(respond, ("POST",))
