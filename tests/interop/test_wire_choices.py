"""The bytes that mosquitto chose wherever the standards leave a choice, and that clients rely on.

A scenario is a text, one step a line. Its first character names a connection (and its client):

    a+ 5 kept {properties}    connect with MQTT 5 or 4 (3.1.1), and be accepted
    a> bytes                  send; a connection that is not there is opened first
    a< bytes or bytes         the next packet that comes, in one of these forms, byte for byte
    a=                        nothing more has come, and the connection is in order
    a.                        nothing more has come, and the broker has closed the connection
    a!                        the client is gone without a word
    wait seconds

Bytes are hexadecimal, or 'text', ~'text' and ~hex with the length in two bytes before, @n (two
bytes), #n (four), {...} with the length of what is inside before, and ACCEPTED, the CONNACK with
code 0. A first byte such as 30| is followed by the length of the packet's rest, and a comma ends
the packet. T/ in a text stands for a topic of two levels that nobody else uses, ID and ID:a for
the client identifier (of a), and ALICE for the user name with the password.
"""

from __future__ import annotations

import re
import time
import uuid
from collections.abc import Iterator

import pytest
from appliance_process import ACL, ApplianceProcess, BrokerProcess
from raw_client import RawClient

#: Characters that a receiver may take as malformed (1.5.4 of MQTT 5, 1.5.3 of 3.1.1).
CONTROL = {"U+0001": "01", "U+001F": "1f", "U+007F": "7f", "U+009F": "c29f"}

#: 200 and 201 slashes, one of which is in T.
DEEP = "T" + "/" * 199
TOO_DEEP = "T" + "/" * 200

#: For the QoS of a delivery: the acknowledgements that are not of that QoS, and their first bytes.
WRONG_ANSWERS = (
    (1, "PUBREC", "50"),
    (1, "PUBCOMP", "70"),
    (2, "PUBACK", "40"),
    (2, "PUBCOMP", "70"),
)

#: mosquitto does all of this from 2.0 on: these run against it too.
PROVED = {
    # CONNECT
    "what CONNACK says": """
        a> 10| ~'MQTT' 05 c2 @60 {} ID ALICE
        a< 20 09 00 00 {22 000a 21 0014}
        a=""",
    "a level that is not known": """
        a> 10| ~'MQTT' 02 c2 @60 ID ALICE
        a< 20 02 00 01
        a.
        b> 10| ~'MQTT' 06 c2 @60 {} ID ALICE
        b< 20 02 00 01
        b.""",
    "another protocol's name": """
        a> 10| ~'MQTQ' 04 c2 @60 ID ALICE
        a.""",
    "a password without its user name, 3.1.1": """
        a> 10| ~'MQTT' 04 42 @60 ID ~'secret'
        a.""",
    "a user name that is announced and not there": """
        a> 10| ~'MQTT' 05 82 @60 {} ID
        a.""",
    **{
        f"{name} in a client identifier, 3.1.1": f"""
        a> 10| ~'MQTT' 04 c2 @60 ~61{code} ALICE
        a."""
        for name, code in CONTROL.items()
    },
    **{
        f"{name} in a user name, version {version}": f"""
        a> 10| ~'MQTT' {version:02} c2 @60 {"" if version == 4 else "{}"} ID ~61{code} ~'secret'
        a."""
        for name, code in CONTROL.items()
        for version in (4, 5)
    },
    **{
        f"{name} in a will's topic": f"""
        a> 10| ~'MQTT' 04 c6 @60 ID ~61{code} ~'gone' ALICE
        a."""
        for name, code in CONTROL.items()
    },
    "another password": """
        a> 10| ~'MQTT' 04 c2 @60 ID ~'alice' ~'wrong'
        a< 20 02 00 05
        a.
        b> 10| ~'MQTT' 05 c2 @60 {} ID ~'alice' ~'wrong'
        b< 20 03 00 87 00
        b.""",
    "no identifier for a session that is to be kept, 3.1.1": """
        a> 10| ~'MQTT' 04 c0 @60 ~'' ALICE
        a< 20 02 00 02
        a.""",
    "an authentication method that is not known": """
        a> 10| ~'MQTT' 05 c2 @60 {15 ~'unknown'} ID ALICE
        a< 20 03 00 8c 00
        a.""",
    "a CONNACK that is larger than the client takes is not sent": """
        a> 10| ~'MQTT' 05 c2 @60 {27 #2} ID ALICE
        a.""",
    # Types and flags
    "type 0": """
        a+ 5
        a> 00 00
        a< e0 01 82
        a.""",
    "DISCONNECT is not answered, whatever is wrong with it": """
        a+ 5
        a> e0 01 01
        a.
        b+ 5
        b> e0 01 05
        b.""",
    # SUBSCRIBE and UNSUBSCRIBE
    **{
        f"{packet} {what}, 3.1.1": f"""
        a+ 4
        a> {first}| @1 {bad} {options}
        a."""
        for packet, first, options in (("SUBSCRIBE to", "82", "01"), ("UNSUBSCRIBE from", "a2", ""))
        for what, bad in (
            ("an empty filter", "~''"),
            ("a/#/b", "~'a/#/b'"),
            ("a+", "~'a+'"),
            *((f"{name} in a filter", f"~61{code}") for name, code in CONTROL.items()),
            ("a filter of 201 slashes", f"~'{TOO_DEEP}'"),
        )
    },
    **{
        f"{packet} {what}": f"""
        a+ 5
        a> {first}| @{packet_id} {{}} {bad} {options}
        a< e0 01 81
        a."""
        for packet, first, options in (("SUBSCRIBE to", "82", "01"), ("UNSUBSCRIBE from", "a2", ""))
        for what, packet_id, bad in (
            ("an empty filter", 1, "~''"),
            ("a/#/b", 1, "~'a/#/b'"),
            ("a+", 1, "~'a+'"),
            ("U+0001 in a filter", 1, "~6101"),
            ("$share/#/x", 1, "~'$share/#/x'"),
            ("a filter, with packet identifier 0", 0, "~'T/x'"),
        )
    },
    "200 slashes in a filter and a topic": f"""
        a+ 4
        a> 82| @1 ~'{DEEP}' 01
        a< 90 03 0001 01
        a> 30| ~'{DEEP}' 'm'
        a< 30| ~'{DEEP}' 'm'
        a=""",
    "a filter twice in a packet": """
        a+ 5
        a> 82| @1 {} ~'T/x' 02 ~'T/x' 01
        a< 90 05 0001 00 02 01
        a> 30| ~'T/x' {} 'm'
        a< 30| ~'T/x' {} 'm'
        a> a2| @2 {} ~'T/x' ~'T/x'
        a< b0 05 0002 00 00 11
        a=""",
    "SUBACK comes before what is retained": """
        a+ 4
        a> 33| ~'T/x' @1 'm'
        a< 40 02 0001
        a> 82| @2 ~'T/x' 00
        a< 90 03 0002 00
        a< 31| ~'T/x' 'm'
        a> 31| ~'T/x'
        a< 30| ~'T/x'
        a=""",
    "retained messages: a topic before those below it, else as their topics came first": """
        a+ 4
        a> 31| ~'T/z/2' '1', 31| ~'T/y' '2', 31| ~'T/z' '3', 31| ~'T/z/1' '4', 31| ~'T/y' '5'
        a> 82| @1 ~'T/#' 00
        a< 90 03 0001 00
        a< 31| ~'T/z' '3'
        a< 31| ~'T/z/2' '1'
        a< 31| ~'T/z/1' '4'
        a< 31| ~'T/y' '5'
        a> 31| ~'T/z/2', 31| ~'T/y', 31| ~'T/z', 31| ~'T/z/1'
        a< 30| ~'T/z/2'
        a< 30| ~'T/y'
        a< 30| ~'T/z'
        a< 30| ~'T/z/1'
        a=""",
    # PUBLISH to the broker
    **{
        f"PUBLISH to a topic with {name}": f"""
        a+ 4
        a> 30| ~61{code} 'm'
        a.
        b+ 5
        b> 30| ~61{code} {{}} 'm'
        b< e0 01 81
        b."""
        for name, code in CONTROL.items()
    },
    "PUBLISH to a topic with a wildcard, 3.1.1": """
        a+ 4
        a> 30| ~'T/+' 'm'
        a.
        b+ 4
        b> 30| ~'T/#' 'm'
        b.""",
    "PUBLISH to a topic of 201 slashes, 3.1.1": f"""
        a+ 4
        a> 30| ~'{TOO_DEEP}' 'm'
        a.""",
    "PUBLISH with packet identifier 0": """
        a+ 5
        a> 32| ~'T/x' @0 {} 'm'
        a< e0 01 82
        a.""",
    "PUBLISH that nobody has subscribed to": """
        a+ 5
        a> 32| ~'T/x' @1 {} 'm'
        a< 40 03 0001 10
        a> 34| ~'T/x' @2 {} 'm'
        a< 50 02 0002
        a> 62 02 0002
        a< 70 02 0002
        a=""",
    "PUBLISH that only the publisher has subscribed to, without its own": """
        a+ 5
        a> 82| @1 {} ~'T/x' 05
        a< 90 04 0001 00 01
        a> 32| ~'T/x' @2 {} 'm'
        a< 40 02 0002
        a=""",
    "PUBLISH that is not allowed": """
        a+ 5
        a> 32| ~'$SYS/broker/uptime' @1 {} 'm'
        a< 40 03 0001 87
        a> 34| ~'$SYS/broker/uptime' @2 {} 'm'
        a< 50 03 0002 87
        a> 30| ~'$SYS/broker/uptime' {} 'm'
        a=
        b+ 4
        b> 32| ~'$SYS/broker/uptime' @1 'm'
        b< 40 02 0001
        b=""",
    "a client that receives what it publishes has it before the PUBACK and the PUBCOMP": """
        a+ 4
        a> 82| @1 ~'T/x' 02
        a< 90 03 0001 02
        a> 32| ~'T/x' @7 'm'
        a< 32| ~'T/x' @1 'm'
        a< 40 02 0007
        a> 40 02 0001
        a> 34| ~'T/x' @8 'n'
        a< 50 02 0008
        a> 62 02 0008
        a< 34| ~'T/x' @2 'n'
        a< 70 02 0008
        a> 50 02 0002
        a< 62 02 0002
        a> 70 02 0002
        a=""",
    "QoS 2: an identifier that is used for another message before PUBREL stands for that one": """
        a+ 4
        a> 82| @1 ~'T/#' 00
        a< 90 03 0001 00
        b+ 4
        b> 34| ~'T/x' @9 'first'
        b< 50 02 0009
        b> 34| ~'T/y' @9 'second'
        b< 50 02 0009
        b> 62 02 0009
        b< 70 02 0009
        a< 30| ~'T/y' 'second'
        a=""",
    "QoS 2: PUBREL and PUBREC for what the other side knows nothing of": """
        a+ 5
        a> 62 02 0001
        a< 70 02 0001
        a> 50 02 0001
        a< 62 02 0001
        a> 50 03 0002 80
        a> 40 02 0003
        a> 70 02 0004
        a=
        b+ 4
        b> 62 02 0001
        b< 70 02 0001
        b> 50 02 0001
        b< 62 02 0001
        b=""",
    # Deliveries and their acknowledgements
    **{
        f"a delivery of QoS {qos} that is answered with {name}, 3.1.1": f"""
        a+ 4
        a> 82| @1 ~'T/x' 02
        a< 90 03 0001 02
        b+ 4
        b> {30 + 2 * qos}| ~'T/x' @1 'm', 62 02 0001
        a< {30 + 2 * qos}| ~'T/x' @1 'm'
        a> {answer} 02 0001
        a."""
        for qos, name, answer in WRONG_ANSWERS
    },
    "PUBREL that is answered with PUBREC comes again": """
        a+ 4
        a> 82| @1 ~'T/x' 02
        a< 90 03 0001 02
        b+ 4
        b> 34| ~'T/x' @1 'm', 62 02 0001
        a< 34| ~'T/x' @1 'm'
        a> 50 02 0001
        a< 62 02 0001
        a> 50 02 0001
        a< 62 02 0001
        a> 70 02 0001
        a=""",
    "a PUBREC with an error ends the delivery": """
        a+ 5
        a> 82| @1 {} ~'T/x' 02
        a< 90 04 0001 00 02
        b+ 5
        b> 34| ~'T/x' @1 {} 'm', 62 02 0001
        a< 34| ~'T/x' @1 {} 'm'
        a> 50 03 0001 80
        a=
        b> 34| ~'T/x' @1 {} 'n', 62 02 0001
        a< 34| ~'T/x' @2 {} 'n'
        a=""",
    "what comes after an interruption: the same identifiers, with DUP, PUBREL again": """
        a+ 5 kept {11 #30 21 @2}
        a> 82| @1 {} ~'T/x' 02
        a< 90 04 0001 00 02
        b+ 5
        b> 34| ~'T/x' @1 {} 'l', 62 02 0001, 32| ~'T/x' @2 {} 'm', 32| ~'T/x' @3 {} 'n'
        a< 34| ~'T/x' @1 {} 'l'
        a< 32| ~'T/x' @2 {} 'm'
        a> 50 02 0001
        a< 62 02 0001
        a!
        a+ 5 kept {11 #30 21 @2}
        a< 62 02 0001
        a< 3a| ~'T/x' @2 {} 'm'
        a=
        a> 70 02 0001
        a< 32| ~'T/x' @3 {} 'n'
        a=
        a> e0 02 00 {11 #0}""",
    "QoS 0 does not wait for a client that is away": """
        a+ 5 kept {11 #30}
        a> 82| @1 {} ~'T/x' 02
        a< 90 04 0001 00 02
        a!
        b+ 5
        b> 30| ~'T/x' {} 'l', 32| ~'T/x' @1 {} 'm'
        b< 40 02 0001
        a+ 5 kept {11 #30}
        a< 32| ~'T/x' @1 {} 'm'
        a=
        a> e0 07 00 {11 #0}""",
    "a message that expires while it waits has had its packet identifier": """
        a+ 5 kept {11 #30}
        a> 82| @1 {} ~'T/x' 01
        a< 90 04 0001 00 01
        a!
        b+ 5
        b> 32| ~'T/x' @1 {02 #1} 'l', 32| ~'T/x' @2 {} 'm'
        b< 40 02 0001
        b< 40 02 0002
        wait 2.2
        a+ 5 kept {11 #30}
        a< 32| ~'T/x' @2 {} 'm'
        a=
        a> e0 07 00 {11 #0}""",
    "three members and two shared subscriptions: each gets the next": """
        a+ 5
        a> 82| @1 {} ~'$share/one/T/x' 00
        a< 90 04 0001 00 00
        b+ 5
        b> 82| @1 {} ~'$share/one/T/x' 00 ~'$share/two/T/x' 00
        b< 90 05 0001 00 00 00
        c+ 5
        c> 82| @1 {} ~'$share/two/T/x' 00
        c< 90 04 0001 00 00
        d+ 5
        d> 82| @1 {} ~'$share/one/T/x' 00
        d< 90 04 0001 00 00
        e+ 5
        e> 30| ~'T/x' {} '1', 30| ~'T/x' {} '2', 30| ~'T/x' {} '3'
        e=
        a< 30| ~'T/x' {} '1'
        a=
        b< 30| ~'T/x' {} '1'
        b< 30| ~'T/x' {} '2'
        b< 30| ~'T/x' {} '3'
        b=
        c< 30| ~'T/x' {} '2'
        c=
        d< 30| ~'T/x' {} '3'
        d=""",
    # PUBLISH from the broker
    "properties are passed on in the publisher's order, and the message expiry follows": """
        a+ 5
        a> 82| @1 {} ~'T/x' 08
        a< 90 04 0001 00 00
        b+ 5
        b> 31| ~'T/x' {26 ~'z' ~'1' 02 #60 09 ~'c' 08 ~'r' 26 ~'a' ~'2' 03 ~'t' 01 01} 'm'
        a< 31| ~'T/x' {26 ~'z' ~'1' 09 ~'c' 08 ~'r' 26 ~'a' ~'2' 03 ~'t' 01 01 02 #60} 'm'
        a=
        c+ 5
        c> 82| @1 {} ~'T/x' 00
        c< 90 04 0001 00 00
        c< 31| ~'T/x' {26 ~'z' ~'1' 09 ~'c' 08 ~'r' 26 ~'a' ~'2' 03 ~'t' 01 01 02 #60} 'm'
            or 31| ~'T/x' {26 ~'z' ~'1' 09 ~'c' 08 ~'r' 26 ~'a' ~'2' 03 ~'t' 01 01 02 #59} 'm'
        c> 31| ~'T/x' {}
        c< 30| ~'T/x' {}
        c=""",
    "a will's properties too": """
        a+ 5
        a> 82| @1 {} ~'T/will' 00
        a< 90 04 0001 00 00
        b> 10| ~'MQTT' 05 c6 @60 {} ID {
            26 ~'z' ~'1' 18 #0 02 #60 08 ~'r' 26 ~'a' ~'2' 03 ~'t'} ~'T/will' ~'m' ALICE
        b< ACCEPTED
        b!
        a< 30| ~'T/will' {26 ~'z' ~'1' 08 ~'r' 26 ~'a' ~'2' 03 ~'t' 02 #60} 'm'
        a=""",
    "the subscription's identifier comes before the publisher's properties": """
        a+ 5
        a> 82| @1 {0b 81 01} ~'T/x' 00
        a< 90 04 0001 00 00
        b+ 5
        b> 30| ~'T/x' {26 ~'z' ~'1' 02 #60 03 ~'t'} 'm'
        a< 30| ~'T/x' {0b 81 01 26 ~'z' ~'1' 03 ~'t' 02 #60} 'm'
        a=""",
    "a publisher's topic alias is its own affair": """
        a+ 5
        a> 82| @1 {} ~'T/x' 00
        a< 90 04 0001 00 00
        a> 30| ~'T/x' {23 @3} 'm'
        a< 30| ~'T/x' {} 'm'
        a> 30| ~'' {23 @3} 'n'
        a< 30| ~'T/x' {} 'n'
        a=""",
    # Wills and the end of a connection
    "a will on a topic of the broker's reaches nobody": """
        a+ 5
        a> 82| @1 {} ~'$SYS/will' 00
        a< 90 04 0001 00 00
        b> 10| ~'MQTT' 05 c6 @60 {} ID {} ~'$SYS/will' ~'m' ALICE
        b< ACCEPTED
        b!
        b+ 5
        a=""",
    "an expiry that the broker agrees with is not repeated": """
        a> 10| ~'MQTT' 05 c0 @60 {11 #30} ID ALICE
        a< 20 09 00 00 {22 000a 21 0014}
        a> e0 07 00 {11 #0}""",
}

#: What mosquitto chose in 2.1, or what 2.0 has nothing of.
CHOSEN = {
    # CONNECT
    **{
        f"{name} in a client identifier": f"""
        a> 10| ~'MQTT' 05 c2 @60 {{}} ~61{code} ALICE
        a< 20 03 00 85 00
        a."""
        for name, code in (*CONTROL.items(), ("U+0000", "00"), ("a surrogate", "eda080"))
    },
    **{
        f"CONNECT with {name}": f"""
        a> 10| ~'MQTT' 05 c2 @60 {{{properties}}} ID ALICE
        a< 20 03 00 {reason} 00
        a."""
        for name, properties, reason in (
            ("a property that breaks off", "11 0000", "81"),
            ("an unknown property", "7f 01", "81"),
            ("a property twice", "11 #1 11 #1", "82"),
            ("Receive Maximum 0", "21 @0", "82"),
            ("Maximum Packet Size 0", "27 #0", "82"),
            ("Request Problem Information 2", "17 02", "82"),
            ("Request Response Information 2", "19 02", "82"),
            ("authentication data without a method", "16 ~'secret'", "82"),
        )
    },
    "CONNECT with more than belongs there": """
        a> 10| ~'MQTT' 05 c2 @60 {} ID ALICE 00
        a< 20 03 00 81 00
        a.""",
    "CONNECT with a will's response topic that is empty": """
        a> 10| ~'MQTT' 05 c6 @60 {} ID {08 ~''} ~'T/will' ~'gone' ALICE
        a< 20 03 00 82 00
        a.""",
    "a second CONNECT": """
        a+ 5
        a> 10| ~'MQTT' 05 c2 @60 {} ID ALICE
        a< e0 01 82
        a.""",
    "a client that connects a second time": """
        a+ 5
        b> 10| ~'MQTT' 05 c2 @60 {} ID:a ALICE
        b< ACCEPTED
        a< e0 01 8e
        a.
        c> 10| ~'MQTT' 04 c2 @60 ID:a ALICE
        c< ACCEPTED
        b< e0 01 8e
        b.
        d> 10| ~'MQTT' 04 c2 @60 ID:a ALICE
        d< ACCEPTED
        c.""",
    # Types and flags
    "type 0 is known by the first byte": """
        a+ 5
        a> 0a
        a< e0 01 82
        a.""",
    **{
        f"{name} from a client, first byte {first:02x}": f"""
        a+ 5
        a> {first:02x} {rest}
        a< e0 01 {reason}
        a."""
        for name, first, rest, reason in (
            ("SUBACK", 0x90, "04 0001 00 00", "82"),
            ("SUBACK", 0x91, "04 0001 00 00", "81"),
            ("UNSUBACK", 0xB0, "04 0001 00 00", "82"),
            ("UNSUBACK", 0xB1, "04 0001 00 00", "81"),
            ("PINGRESP", 0xD0, "00", "82"),
            ("PINGRESP", 0xD1, "00", "81"),
            ("CONNACK", 0x20, "03 00 00 00", "82"),
            ("AUTH without a method in CONNECT", 0xF0, "00", "82"),
            ("AUTH without a method in CONNECT", 0xF1, "00", "82"),
        )
    },
    # SUBSCRIBE and UNSUBSCRIBE
    **{
        f"SUBSCRIBE to {name}": f"""
        a+ 5
        a> 82| @1 {{}} ~'{name}' 00
        a< e0 01 82
        a."""
        for name in ("$share/+/x", "$share/x/", "$share/x")
    },
    "SUBSCRIBE with a subscription identifier that breaks off": """
        a+ 5
        a> 82| @1 {0b} ~'T/x' 00
        a< e0 01 81
        a.""",
    "SUBSCRIBE to a filter of 201 slashes": f"""
        a+ 5
        a> 82| @1 {{}} ~'{TOO_DEEP}' 00
        a< e0 01 81
        a.""",
    "a shared subscription does not exclude one's own messages": """
        a+ 5
        a> 82| @1 {} ~'$share/one/T/x' 05
        a< e0 01 82
        a.""",
    # PUBLISH to the broker
    "PUBLISH to a topic with a wildcard": """
        a+ 5
        a> 30| ~'T/+' {} 'm'
        a< e0 01 81
        a.""",
    "PUBLISH to a topic of 201 slashes": f"""
        a+ 5
        a> 30| ~'{TOO_DEEP}' {{}} 'm'
        a< e0 01 81
        a.""",
    "PUBLISH with a payload format that breaks off": """
        a+ 5
        a> 30| ~'T/x' {01}
        a< e0 01 81
        a.""",
    # Deliveries and their acknowledgements
    **{
        f"a delivery of QoS {qos} that is answered with {name}": f"""
        a+ 5
        a> 82| @1 {{}} ~'T/x' 02
        a< 90 04 0001 00 02
        b+ 5
        b> {30 + 2 * qos}| ~'T/x' @1 {{}} 'm', 62 02 0001
        a< {30 + 2 * qos}| ~'T/x' @1 {{}} 'm'
        a> {answer} 02 0001
        a< e0 01 82
        a."""
        for qos, name, answer in WRONG_ANSWERS
    },
    "a message that is larger than the client takes is not sent, but has its packet identifier": """
        a+ 5 {27 #40}
        a> 82| @1 {} ~'T/x' 01
        a< 90 04 0001 00 01
        b+ 5
        b> 32| ~'T/x' @1 {} '0123456789012345678901234567890123456789'
        b< 40 02 0001
        b> 32| ~'T/x' @2 {} 'm'
        b< 40 02 0002
        a< 32| ~'T/x' @2 {} 'm'
        a=""",
    # PUBLISH from the broker
    "topics get aliases in the order they come in, up to the client's maximum and to ten": (
        """
        a+ 5 {22 @65535}
        a> 82| @1 {} ~'T/#' 00
        a< 90 04 0001 00 00
        """
        + "".join(
            f"""
        a> 30| ~'T/{number}' {{}} 'm'
        a< 30| ~'T/{number}' {{23 @{number}}} 'm'
        a> 30| ~'T/{number}' {{}} 'n'
        a< 30| ~'' {{23 @{number}}} 'n'"""
            for number in range(1, 11)
        )
        + """
        a> 30| ~'T/11' {} 'm'
        a< 30| ~'T/11' {} 'm'
        a=
        b+ 5 {22 @1}
        b> 82| @1 {} ~'T/#' 00
        b< 90 04 0001 00 00
        b> 30| ~'T/1' {} 'm', 30| ~'T/2' {} 'm', 30| ~'T/1' {} 'n'
        b< 30| ~'T/1' {23 @1} 'm'
        b< 30| ~'T/2' {} 'm'
        b< 30| ~'' {23 @1} 'n'
        b="""
    ),
    "the alias comes first, then the subscription's identifier and what the publisher said": """
        a+ 5 {22 @1}
        a> 82| @1 {0b 05} ~'T/x' 00
        a< 90 04 0001 00 00
        a> 30| ~'T/x' {26 ~'z' ~'1' 02 #60 03 ~'t'} 'm'
        a< 30| ~'T/x' {23 @1 0b 05 26 ~'z' ~'1' 03 ~'t' 02 #60} 'm'
        a=""",
}

#: For a broker whose longest keep alive is 60 s.
LIMITED = {
    "the longest keep alive": """
        a> 10| ~'MQTT' 05 c2 @60 {} ID ALICE
        a< 20 09 00 00 {22 000a 21 0014}
        b> 10| ~'MQTT' 04 c2 @60 ID ALICE
        b< 20 02 00 00""",
    **{
        f"keep alive {seconds} is too long": f"""
        a> 10| ~'MQTT' 05 c2 @{seconds} {{}} ID ALICE
        a< 20 0c 00 00 {{13 003c 22 000a 21 0014}}
        a=
        b> 10| ~'MQTT' 04 c2 @{seconds} ID ALICE
        b< 20 02 00 02
        b."""
        for seconds in (61, 0)
    },
}

STEP = re.compile(r"(?P<peer>[a-z])(?P<kind>[+><=.!])\s*(?P<rest>.*)", re.DOTALL)
WORD = re.compile(r"[{},]|~?'[^']*'|~?[^\s{},]+")


class Stage:
    """The connections of one scenario."""

    def __init__(self, broker: BrokerProcess) -> None:
        self._broker = broker
        self._name = f"w{uuid.uuid4().hex[:8]}"
        self._peers: dict[str, RawClient] = {}

    def play(self, scenario: str) -> None:
        try:
            for step in _steps(scenario):
                self._play(step)
        finally:
            for peer in self._peers.values():
                peer.socket.close()

    def _play(self, step: str) -> None:
        if step.startswith("wait"):
            time.sleep(float(step.split()[1]))
            return
        parts = STEP.fullmatch(step)
        assert parts is not None, step
        name, kind, rest = parts["peer"], parts["kind"], parts["rest"]
        if kind in ">+" and name not in self._peers:
            self._peers[name] = RawClient(self._broker, 5)
        peer = self._peers[name]
        if kind == "+":
            peer.socket.sendall(self._bytes(_connect(rest), name))
            self._expect(step, peer, "ACCEPTED", name)
        elif kind == ">":
            peer.socket.sendall(self._bytes(rest, name))
        elif kind == "<":
            self._expect(step, peer, rest, name)
        elif kind == "=":
            peer.socket.sendall(b"\xc0\x00")
            self._expect(step, peer, "d0 00", name)
        elif kind == ".":
            self._expect(step, peer, "", name)
            self._peers.pop(name).socket.close()
        else:
            self._peers.pop(name).kill()

    def _expect(self, step: str, peer: RawClient, forms: str, name: str) -> None:
        try:
            received = peer.receive()
        except ConnectionResetError:  # closed with something of ours unread
            received = b""
        except TimeoutError:
            pytest.fail(f"nothing comes: {step}")
        if forms == "ACCEPTED":
            assert received[:1] == b"\x20", f"{step}: {received.hex(' ')}"
            assert received[3:4] == b"\x00", f"{step}: {received.hex(' ')}"
            return
        expected = [self._bytes(form, name).hex(" ") for form in re.split(r"\sor\s", forms)]
        assert received.hex(" ") in expected, step

    def _bytes(self, text: str, name: str) -> bytes:
        """What the notation stands for, on the connection of this name."""
        packets = b""
        first: str | None = None
        levels = [b""]
        for word in WORD.findall(text):
            if word == ",":
                packets += _packet(first, levels.pop())
                first, levels = None, [b""]
            elif word.endswith("|"):
                first = word[:-1]
            elif word == "{":
                levels.append(b"")
            elif word == "}":
                inner = levels.pop()
                levels[-1] += _length(len(inner)) + inner
            else:
                levels[-1] += self._word(word, name)
        return packets + _packet(first, levels.pop())

    def _word(self, word: str, name: str) -> bytes:
        if word == "ALICE":
            return _string(b"alice") + _string(self._broker.passwords["alice"].encode())
        if word.startswith("ID"):
            return _string(f"{self._name}-{word[3:] or name}".encode())
        if word.startswith("@"):
            return int(word[1:]).to_bytes(2, "big")
        if word.startswith("#"):
            return int(word[1:]).to_bytes(4, "big")
        if word.startswith("~"):
            return _string(self._word(word[1:], name))
        if word.startswith("'"):
            return re.sub(r"\bT(?=/)", f"r2d2/{self._name}", word[1:-1]).encode()
        return bytes.fromhex(word)


def _steps(scenario: str) -> Iterator[str]:
    """The steps, with the lines that continue one."""
    start = re.compile(r"^\s*(?=[a-z][+><=.!]|wait )", re.MULTILINE)
    return (step.strip() for step in start.split(scenario) if step.strip())


def _connect(words: str) -> str:
    """The CONNECT of a step such as `a+ 5 kept {properties}`."""
    version, _, properties = words.partition(" ")
    kept = properties.startswith("kept")
    properties = properties.removeprefix("kept").strip()
    flags = "c0" if kept else "c2"
    if version == "5":
        properties = properties or "{}"
    return f"10| ~'MQTT' {int(version):02} {flags} @60 {properties} ID ALICE"


def _packet(first: str | None, body: bytes) -> bytes:
    return body if first is None else bytes.fromhex(first) + _length(len(body)) + body


def _length(number: int) -> bytes:
    """A variable byte integer (1.5.5)."""
    encoded = b""
    while number > 127:
        encoded += bytes([number & 127 | 128])
        number >>= 7
    return encoded + bytes([number])


def _string(data: bytes) -> bytes:
    return len(data).to_bytes(2, "big") + data


@pytest.fixture(scope="module")
def limited(tmp_path_factory: pytest.TempPathFactory) -> Iterator[ApplianceProcess]:
    """An appliance that wants to hear from its clients once a minute."""
    limits = {"keep_alive": "60 s"}
    process = ApplianceProcess(
        tmp_path_factory.mktemp("limited"), acl=ACL, broker={"limits": limits}
    )
    process.start()
    yield process
    process.stop()


@pytest.mark.parametrize("name", PROVED)
def test_as_mosquitto_2_0_and_later(broker: BrokerProcess, name: str) -> None:
    Stage(broker).play(PROVED[name])


@pytest.mark.parametrize("name", CHOSEN)
def test_as_mosquitto_2_1(appliance: ApplianceProcess, name: str) -> None:
    Stage(appliance).play(CHOSEN[name])


@pytest.mark.parametrize("name", LIMITED)
def test_with_a_limit_on_the_keep_alive(limited: ApplianceProcess, name: str) -> None:
    Stage(limited).play(LIMITED[name])


def test_an_identifier_that_the_broker_chooses(broker: BrokerProcess) -> None:
    """mosquitto's are `auto-` and a UUID, and there are suites that count the bytes."""
    with RawClient(broker, 5) as client:
        connack = client.connect("", keep_alive=60)
    assert re.fullmatch(
        rb"\x20.\x00\x00.\x22\x00\x0a\x12\x00\x29"
        rb"auto-[0-9A-F]{8}(-[0-9A-F]{4}){3}-[0-9A-F]{12}\x21\x00\x14",
        connack,
        re.DOTALL,
    ), connack
